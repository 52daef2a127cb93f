/* Kernel of `targets/cuts/graph.py`. */
#include "arguments.h"

#include <string.h>

/* Elements of a surface in the order in which they were found, and a mark for each element of the surface among them. */
typedef struct {
    int64_t *found;
    uint8_t *among;
    int64_t size;
    Py_ssize_t all;
} Elements;

static Elements none(const Argument *found, const Argument *among)
{
    return (Elements){found->data, among->data, 0, found->size};
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

static void sort(Elements *elements)
{
    const uint8_t *here = elements->among, *end = here + elements->all;
    for (int64_t k = 0; k < elements->size; k++, here++) {
        here = memchr(here, 1, (size_t)(end - here));
        elements->found[k] = here - elements->among;
    }
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

static void clear(Elements *elements)
{
    for (int64_t i = 0; i < elements->size; i++)
        elements->among[elements->found[i]] = 0;
}

/* (start, star, F, side, seeds, rings, triangles, vertices, edges, corners, sides, near, at, along, sizes): the triangles
 * in some rings around vertices, their vertices and edges, and how many there are of each. `near`, `at` and `along` are
 * zeros, before and after. */
static PyObject *gather_part(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[15];
    if (!take("gather_part", given, count, "qqqqqnQQQQQBBBQ", a))
        return NULL;
    const int64_t *start = a[0].data, *star = a[1].data, *F = a[2].data, *side = a[3].data, *seeds = a[4].data;
    const Py_ssize_t f = a[6].size, n = a[7].size, e = a[8].size, rings = a[5].integer;
    int64_t *corners = a[9].data, *sides = a[10].data, *sizes = a[14].data;
    if (!fit("gather_part", a, LENGTH(a),
             a[0].size == n + 1 && a[1].size == 3 * f && a[2].size == 3 * f && a[3].size == 3 * f && a[9].size == 3 * f
                 && a[10].size == 3 * f && a[11].size == f && a[12].size == n && a[13].size == e && a[14].size == 3
                 && are_indices(a + 4, n)))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    Elements triangles = none(a + 6, a + 11), vertices = none(a + 7, a + 12), edges = none(a + 8, a + 13);
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
    sort(&triangles);
    sort(&vertices);
    sort(&edges);
    for (int64_t i = 0; i < triangles.size; i++)
        for (int c = 0; c < 3; c++) {
            corners[3 * i + c] = place(&vertices, F[3 * triangles.found[i] + c]);
            sides[3 * i + c] = place(&edges, side[c * f + triangles.found[i]]);
        }
    clear(&triangles);
    clear(&vertices);
    clear(&edges);
    sizes[0] = triangles.size;
    sizes[1] = vertices.size;
    sizes[2] = edges.size;
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef part_kernels[] = {KERNEL(gather_part), END_OF_KERNELS};
