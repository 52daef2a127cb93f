/* Kernel of `targets/cuts/graph.py`. */
#include "arguments.h"
#include "sorting.h"

DEFINE_SORT(sort, int64_t)

/* Elements of a surface in the order in which they were found, and a mark for each element of the surface among them. */
typedef struct {
    int64_t *found;
    uint8_t *among;
    int64_t size;
} Elements;

/* 0 if there is no memory. */
static int make(Elements *elements, const Argument *found)
{
    elements->found = found->data;
    elements->size = 0;
    /* Marks of one byte, because few pages of memory are touched then. */
    elements->among = calloc((size_t)found->size + 1, sizeof(*elements->among));
    return elements->among != NULL;
}

/* 1 if the element is new. */
static int add(Elements *elements, int64_t element)
{
    if (elements->among[element])
        return 0;
    elements->among[element] = 1;
    elements->found[elements->size++] = element;
    return 1;
}

/* The place of an element that was found among all of them, in ascending order. */
static int64_t place(const Elements *sorted, int64_t element)
{
    int64_t low = 0, high = sorted->size - 1;
    while (low < high) {
        const int64_t middle = low + (high - low) / 2;
        if (sorted->found[middle] < element)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* (start, star, F, side, seeds, rings, triangles, vertices, edges, corners, sides, sizes): the triangles in some rings
 * around vertices, their vertices and edges, and how many there are of each. */
static PyObject *gather_part(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[12];
    if (!take("gather_part", given, count, "qqqqqnQQQQQQ", a))
        return NULL;
    const int64_t *start = a[0].data, *star = a[1].data, *F = a[2].data, *side = a[3].data, *seeds = a[4].data;
    const Py_ssize_t f = a[6].size, n = a[7].size, rings = a[5].integer;
    int64_t *corners = a[9].data, *sides = a[10].data, *sizes = a[11].data;
    if (!fit("gather_part", a, LENGTH(a),
             a[0].size == n + 1 && a[1].size == 3 * f && a[2].size == 3 * f && a[3].size == 3 * f && a[9].size == 3 * f
                 && a[10].size == 3 * f && a[11].size == 3 && are_indices(a + 4, n)))
        return NULL;
    Elements triangles, vertices, edges;
    const int made[] = {make(&triangles, a + 6), make(&vertices, a + 7), make(&edges, a + 8)};
    if (made[0] && made[1] && made[2]) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < a[4].size; i++)
            add(&vertices, seeds[i]);
        for (Py_ssize_t i = 0, ring = 0; ring < rings; ring++)
            for (const int64_t until = vertices.size; i < until; i++)
                for (int64_t k = start[vertices.found[i]]; k < start[vertices.found[i] + 1]; k++)
                    if (add(&triangles, star[k]))
                        for (int c = 0; c < 3; c++) {
                            add(&vertices, F[3 * star[k] + c]);
                            add(&edges, side[c * f + star[k]]);
                        }
        sort(triangles.found, triangles.size);
        sort(vertices.found, vertices.size);
        sort(edges.found, edges.size);
        for (int64_t i = 0; i < triangles.size; i++)
            for (int c = 0; c < 3; c++) {
                corners[3 * i + c] = place(&vertices, F[3 * triangles.found[i] + c]);
                sides[3 * i + c] = place(&edges, side[c * f + triangles.found[i]]);
            }
        sizes[0] = triangles.size;
        sizes[1] = vertices.size;
        sizes[2] = edges.size;
        Py_END_ALLOW_THREADS
    }
    free(triangles.among);
    free(vertices.among);
    free(edges.among);
    return made[0] && made[1] && made[2] ? done(a, LENGTH(a)) : out_of_memory(a, LENGTH(a));
}

PyMethodDef part_kernels[] = {KERNEL(gather_part), END_OF_KERNELS};
