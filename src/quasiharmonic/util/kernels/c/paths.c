/* Kernel of `targets/cuts/graph.py`. */
#include "arguments.h"
#include "heap.h"

#include <math.h>
#include <stdlib.h>

/* Neighbours of vertex i and the edges to them: those from start[i] to start[i + 1]. */
typedef struct {
    const int64_t *start, *neighbour, *edge;
    const double *weight;
    double limit;
    double *distance;
    int64_t *before;
} Graph;

static void relax(const Graph *graph, Heap *heap, Entry here)
{
    for (int64_t k = graph->start[here.node]; k < graph->start[here.node + 1]; k++) {
        const int64_t other = graph->neighbour[k];
        const double longer = here.distance + graph->weight[graph->edge[k]];
        if (longer <= graph->limit && longer < graph->distance[other]) {
            graph->distance[other] = longer;
            graph->before[other] = here.node;
            push(heap, (Entry){longer, other});
        } else if (longer == graph->distance[other] && here.distance < longer && here.node < graph->before[other])
            graph->before[other] = here.node;
    }
}

/* (start, neighbour, edge, weight, sources, limit, distance, before): the distance of each vertex from the nearest source,
 * and the vertex before it on the path. */
static PyObject *find_shortest_paths(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[8];
    if (!take("find_shortest_paths", given, count, "qqqdqxDQ", a))
        return NULL;
    const Py_ssize_t n = a[6].size;
    const int64_t *sources = a[4].data;
    if (!fit("find_shortest_paths", a, LENGTH(a),
             a[1].size == a[2].size && a[0].size == n + 1 && are_parts(a, a[1].size) && a[7].size == n
                 && are_indices(a + 1, n) && are_indices(a + 2, a[3].size) && are_indices(a + 4, n)))
        return NULL;
    const Graph graph = {a[0].data, a[1].data, a[2].data, a[3].data, a[5].number, a[6].data, a[7].data};
    /* No weight is negative. So every vertex is a source at most once, and has a shorter path from each of its neighbours
     * at most once. */
    Heap heap = {malloc((size_t)(n + a[1].size + 1) * sizeof(Entry)), 0};
    if (!heap.entries)
        return out_of_memory(a, LENGTH(a));
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < n; i++) {
        graph.distance[i] = INFINITY;
        graph.before[i] = -1;
    }
    for (Py_ssize_t i = 0; i < a[4].size; i++)
        if (graph.distance[sources[i]] > 0) {
            graph.distance[sources[i]] = 0;
            push(&heap, (Entry){0, sources[i]});
        }
    while (heap.size > 0) {
        const Entry here = pop(&heap);
        if (here.distance <= graph.distance[here.node])
            relax(&graph, &heap, here);
    }
    Py_END_ALLOW_THREADS
    free(heap.entries);
    return done(a, LENGTH(a));
}

PyMethodDef paths_kernels[] = {KERNEL(find_shortest_paths), END_OF_KERNELS};
