/* Kernels of `geometry/mesh/topology.py`. */
#include "arguments.h"
#include "sorting.h"

#include <stdlib.h>
#include <string.h>

DEFINE_SORT(sort, uint32_t)
DEFINE_SORT(sort_wide, uint64_t)

/* Where the half-edges end that are of the same edge as others[from], all of them before `until`. */
static int64_t end_of_edge(const uint32_t *others, int64_t from, int64_t until)
{
    const uint32_t high = others[from] / 2;
    while (from < until && others[from] / 2 == high)
        from++;
    return from;
}

enum { INTERIOR, BOUNDARY, INCONSISTENT, NONMANIFOLD, KINDS };

/* The kind of an edge with so many half-edges, the first of which is at `others`. */
static int kind(const uint32_t *others, int64_t halves)
{
    if (halves == 2)
        return others[0] == others[1] ? INCONSISTENT : INTERIOR;
    return halves == 1 ? BOUNDARY : NONMANIFOLD;
}

/* Half-edges by the smaller ends of their edges: where those of each vertex start, and twice the larger ends of their
 * edges, and one on top where they run from it, in ascending order. */
static void bucket(const int64_t *F, Py_ssize_t halves, Py_ssize_t n, int64_t *starts, uint32_t *others)
{
    memset(starts, 0, (size_t)(n + 1) * sizeof(*starts));
    for (Py_ssize_t j = 0; j < halves; j += 3)
        for (int e = 0; e < 3; e++) {
            const int64_t tail = F[j + e], head = F[j + (e + 1) % 3];
            starts[tail < head ? tail : head]++;
        }
    /* Where each bucket ends. It is filled from behind, and then it starts there. */
    for (Py_ssize_t i = 1; i <= n; i++)
        starts[i] += starts[i - 1];
    for (Py_ssize_t j = 0; j < halves; j += 3)
        for (int e = 0; e < 3; e++) {
            const int64_t tail = F[j + e], head = F[j + (e + 1) % 3];
            if (tail > head)
                others[--starts[head]] = 2 * (uint32_t)tail + 1;
            else
                others[--starts[tail]] = 2 * (uint32_t)head;
        }
    for (Py_ssize_t i = 0; i < n; i++)
        sort(others + starts[i], starts[i + 1] - starts[i]);
}

/* Edges of one kind after those of another, and how many there are of each. */
static void list_edges(const int64_t *starts, const uint32_t *others, Py_ssize_t n, int64_t *pairs, int64_t *sizes)
{
    int64_t *at[KINDS];
    memset(sizes, 0, KINDS * sizeof(*sizes));
    for (int64_t k = 0, next, i = 0; i < n; i++)
        for (; k < starts[i + 1]; k = next) {
            next = end_of_edge(others, k, starts[i + 1]);
            sizes[kind(others + k, next - k)]++;
        }
    for (int each = 0; each < KINDS; each++)
        at[each] = each ? at[each - 1] + 2 * sizes[each - 1] : pairs;
    for (int64_t k = 0, next, i = 0; i < n; i++)
        for (; k < starts[i + 1]; k = next) {
            next = end_of_edge(others, k, starts[i + 1]);
            const int of = kind(others + k, next - k), turned = of == BOUNDARY && others[k] % 2;
            at[of][turned] = i;
            at[of][!turned] = others[k] / 2;
            at[of] += 2;
        }
}

/* (F, n, pairs, sizes): the edges of triangles, kind by kind; 0 where F names a vertex that there is not. */
static PyObject *sort_edges(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[4];
    if (!take("sort_edges", given, count, "qnQQ", a))
        return NULL;
    const int64_t *F = a[0].data;
    const Py_ssize_t halves = a[0].size, n = a[1].integer;
    if (!fit("sort_edges", a, LENGTH(a),
             halves % 3 == 0 && 0 <= n && n <= INT32_MAX && a[2].size >= 2 * halves && a[3].size == KINDS))
        return NULL;
    if (!are_indices(a, n))
        return done_with_integer(a, LENGTH(a), 0);
    int64_t *starts = malloc((size_t)(n + 1) * sizeof(*starts));
    uint32_t *others = malloc((size_t)(halves + 1) * sizeof(*others));
    if (!starts || !others) {
        free(starts);
        free(others);
        return out_of_memory(a, LENGTH(a));
    }
    Py_BEGIN_ALLOW_THREADS
    bucket(F, halves, n, starts, others);
    list_edges(starts, others, n, a[2].data, a[3].data);
    Py_END_ALLOW_THREADS
    free(starts);
    free(others);
    return done_with_integer(a, LENGTH(a), 1);
}

/* The edges of triangles in ascending order, and the edge of each half-edge; returned is the number of edges. `others`
 * gets the larger end and the number of each half-edge. */
static int64_t number(const int64_t *F, Py_ssize_t halves, Py_ssize_t n, int64_t *starts, uint64_t *others, int64_t *side,
                      int64_t *ends)
{
    memset(starts, 0, (size_t)(n + 1) * sizeof(*starts));
    for (Py_ssize_t j = 0; j < halves; j++) {
        const int64_t tail = F[j], head = F[j % 3 == 2 ? j - 2 : j + 1];
        starts[tail < head ? tail : head]++;
    }
    for (Py_ssize_t i = 1; i <= n; i++)
        starts[i] += starts[i - 1];
    for (Py_ssize_t j = 0; j < halves; j++) {
        const int64_t tail = F[j], head = F[j % 3 == 2 ? j - 2 : j + 1];
        const int64_t low = tail < head ? tail : head;
        others[--starts[low]] = (uint64_t)(tail < head ? head : tail) << 32 | (uint64_t)j;
    }
    int64_t count = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        sort_wide(others + starts[i], starts[i + 1] - starts[i]);
        for (int64_t k = starts[i]; k < starts[i + 1]; k++) {
            const int64_t high = (int64_t)(others[k] >> 32);
            if (k == starts[i] || (int64_t)(others[k - 1] >> 32) != high) {
                ends[2 * count] = i;
                ends[2 * count++ + 1] = high;
            }
            side[others[k] & UINT32_MAX] = count - 1;
        }
    }
    return count;
}

/* (F, n, side, ends): the number of the edges of triangles, which are listed in ascending order, and the edge of each
 * half-edge; -1 where F names a vertex that there is not. */
static PyObject *number_sides(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[4];
    if (!take("number_sides", given, count, "qnQQ", a))
        return NULL;
    const Py_ssize_t halves = a[0].size, n = a[1].integer;
    if (!fit("number_sides", a, LENGTH(a),
             halves % 3 == 0 && halves <= UINT32_MAX && 0 <= n && n <= INT32_MAX && a[2].size >= halves
                 && a[3].size >= 2 * halves))
        return NULL;
    if (!are_indices(a, n))
        return done_with_integer(a, LENGTH(a), -1);
    int64_t *starts = malloc((size_t)(n + 1) * sizeof(*starts));
    uint64_t *others = malloc((size_t)(halves + 1) * sizeof(*others));
    if (!starts || !others) {
        free(starts);
        free(others);
        return out_of_memory(a, LENGTH(a));
    }
    int64_t edges;
    Py_BEGIN_ALLOW_THREADS
    edges = number(a[0].data, halves, n, starts, others, a[2].data, a[3].data);
    Py_END_ALLOW_THREADS
    free(starts);
    free(others);
    return done_with_integer(a, LENGTH(a), (Py_ssize_t)edges);
}

/* Marks in `first`: no side of the edge so far, and two or more sides, of which the first one is TWO_SIDES minus the mark. */
enum { NO_SIDE = -1, TWO_SIDES = -2 };

/* The other side of the same edge for each side, -1 where an edge has not exactly two. `first` gets the first side of each
 * edge, or a mark. */
static void pair(const int64_t *side, Py_ssize_t sides, int64_t *first, int64_t *opposite)
{
    for (int64_t j = 0; j < sides; j++) {
        int64_t *here = first + side[j];
        opposite[j] = -1;
        if (*here == NO_SIDE)
            *here = j;
        else if (*here >= 0) {
            opposite[j] = *here;
            opposite[*here] = j;
            *here = TWO_SIDES - *here;
        } else {
            const int64_t one = TWO_SIDES - *here, other = opposite[one];
            opposite[one] = -1;
            if (other >= 0)
                opposite[other] = -1;
        }
    }
}

/* (side, edges, opposite): the other side of the same edge for each side of triangles; 0 where `side` names an edge that
 * there is not. */
static PyObject *find_opposite(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("find_opposite", given, count, "qnQ", a))
        return NULL;
    const Py_ssize_t edges = a[1].integer;
    if (!fit("find_opposite", a, LENGTH(a), edges >= 0 && a[2].size == a[0].size))
        return NULL;
    if (!are_indices(a, edges))
        return done_with_integer(a, LENGTH(a), 0);
    int64_t *first = malloc((size_t)(edges + 1) * sizeof(*first));
    if (!first)
        return out_of_memory(a, LENGTH(a));
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < edges; i++)
        first[i] = NO_SIDE;
    pair(a[0].data, a[0].size, first, a[2].data);
    Py_END_ALLOW_THREADS
    free(first);
    return done_with_integer(a, LENGTH(a), 1);
}

/* The root of a node, and the way there halved. */
static int64_t root(int64_t *label, int64_t node)
{
    while (label[node] != node)
        node = label[node] = label[label[node]];
    return node;
}

/* (tail, head, label): the smallest node of the component of every node of a graph; 0 where there is no such node as a
 * link names. */
static PyObject *link_nodes(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("link_nodes", given, count, "~q~qQ", a))
        return NULL;
    const int64_t *tails = a[0].data, *heads = a[1].data;
    int64_t *label = a[2].data;
    const Py_ssize_t n = a[2].size, rows = a[0].rows, columns = a[0].columns;
    if (!fit("link_nodes", a, LENGTH(a),
             a[1].rows == rows && a[1].columns == columns))
        return NULL;
    int known = 1;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < n; i++)
        label[i] = i;
    for (Py_ssize_t i = 0; i < rows && known; i++)
        for (Py_ssize_t j = 0; j < columns && known; j++) {
            int64_t one = tails[i * a[0].row_stride + j * a[0].stride];
            int64_t other = heads[i * a[1].row_stride + j * a[1].stride];
            known = one >= 0 && one < n && other >= 0 && other < n;
            if (!known)
                break;
            one = root(label, one);
            other = root(label, other);
            if (one < other)
                label[other] = one;
            else
                label[one] = other;
        }
    /* No node's label is larger than itself, so its label's label is there already. */
    for (Py_ssize_t i = 0; i < n; i++)
        label[i] = label[label[i]];
    Py_END_ALLOW_THREADS
    return done_with_integer(a, LENGTH(a), known);
}

typedef struct {
    int64_t tail, head;
} HalfEdge;

static int by_tail(const void *one, const void *other)
{
    const int64_t a = ((const HalfEdge *)one)->tail, b = ((const HalfEdge *)other)->tail;
    return (a > b) - (a < b);
}

/* The half-edge, of `size` in ascending order, that starts at a vertex; NULL if there is none. */
static HalfEdge *starting_at(HalfEdge *sorted, Py_ssize_t size, int64_t vertex)
{
    Py_ssize_t low = 0, high = size;
    while (low < high) {
        const Py_ssize_t middle = low + (high - low) / 2;
        if (sorted[middle].tail < vertex)
            low = middle + 1;
        else
            high = middle;
    }
    return low < size && sorted[low].tail == vertex ? sorted + low : NULL;
}

/* Follow sorted half-edges; the number of loops, or -1 where they make none. A half-edge that has been passed has -1 for
 * its head. */
static Py_ssize_t follow(HalfEdge *sorted, Py_ssize_t size, int64_t *vertices, int64_t *lengths)
{
    Py_ssize_t loops = 0, passed = 0;
    for (Py_ssize_t i = 0; i < size; i++)
        if (sorted[i].tail < 0 || sorted[i].head < 0 || (i && sorted[i].tail == sorted[i - 1].tail))
            return -1;
    for (Py_ssize_t first = 0; first < size; first++) {
        if (sorted[first].head < 0)
            continue;
        const Py_ssize_t before = passed;
        HalfEdge *here = sorted + first;
        while (here && here->head >= 0) {
            const int64_t head = here->head;
            vertices[passed++] = here->tail;
            here->head = -1;
            here = starting_at(sorted, size, head);
        }
        if (here != sorted + first)
            return -1;
        lengths[loops++] = passed - before;
    }
    return loops;
}

/* (boundary, vertices, lengths): half-edges put in the order of loops; their number, or -1 where they make none. */
static PyObject *follow_loops(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("follow_loops", given, count, "qQQ", a))
        return NULL;
    const Py_ssize_t size = a[1].size;
    if (!fit("follow_loops", a, LENGTH(a),
             a[0].size == 2 * size && a[2].size == size))
        return NULL;
    HalfEdge *sorted = malloc((size_t)(size ? size : 1) * sizeof(*sorted));
    if (!sorted)
        return out_of_memory(a, LENGTH(a));
    Py_ssize_t loops;
    Py_BEGIN_ALLOW_THREADS
    memcpy(sorted, a[0].data, (size_t)size * sizeof(*sorted));
    qsort(sorted, (size_t)size, sizeof(*sorted), by_tail);
    loops = follow(sorted, size, a[1].data, a[2].data);
    Py_END_ALLOW_THREADS
    free(sorted);
    return done_with_integer(a, LENGTH(a), loops);
}

PyMethodDef topology_kernels[] = {
    KERNEL(sort_edges), KERNEL(number_sides), KERNEL(find_opposite), KERNEL(link_nodes), KERNEL(follow_loops), END_OF_KERNELS,
};
