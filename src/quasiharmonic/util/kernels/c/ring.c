/* Kernels of `targets/cuts/shortening.py`. */
#include "arguments.h"
#include "heap.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* A surface opened at borders. Half-edge and corner 3 t + k of triangle t are those from and at its corner k. */
typedef struct {
    const int64_t *opposite, *side;
    const char *border;
    const double *cost;
    /* The half-edge across each half-edge, -1 at borders and where no triangle follows; the node of each corner: the
     * smallest corner of its part of a vertex; and the loop of border edges of each node, -1 away from borders. */
    int64_t *across, *node, *loop;
    double *distance;
    /* No path is longer. */
    double limit;
} Ring;

static int64_t next_of(int64_t half)
{
    return half % 3 == 2 ? half - 2 : half + 1;
}

static int64_t previous_of(int64_t half)
{
    return half % 3 == 0 ? half + 2 : half - 1;
}

static int64_t root(int64_t *label, int64_t item)
{
    while (label[item] != item)
        item = label[item] = label[label[item]];
    return item;
}

static void join_labels(int64_t *label, int64_t one, int64_t other)
{
    one = root(label, one);
    other = root(label, other);
    if (one < other)
        label[other] = one;
    else
        label[one] = other;
}

typedef struct {
    int64_t corner, begun;
    int turned;
} Fan;

/* The corner after one in a fan; -1 after the last. Fans are followed in one direction, then in the other. */
static int64_t next_corner(const Ring *ring, Fan *fan)
{
    if (!fan->turned) {
        const int64_t across = ring->across[fan->corner];
        if (across >= 0) {
            fan->corner = next_of(across);
            return fan->corner == fan->begun ? -1 : fan->corner;
        }
        fan->turned = 1;
        fan->corner = fan->begun;
    }
    const int64_t across = ring->across[previous_of(fan->corner)];
    if (across < 0)
        return -1;
    return fan->corner = across;
}

/* Number the nodes and the loops. */
static void label_nodes(const Ring *ring, int64_t halves)
{
    for (int64_t h = 0; h < halves; h++) {
        ring->across[h] = ring->border[ring->side[h]] ? -1 : ring->opposite[h];
        ring->node[h] = ring->loop[h] = -1;
    }
    for (int64_t h = 0; h < halves; h++)
        if (ring->node[h] < 0) {
            Fan fan = {h, h, 0};
            for (int64_t corner = h; corner >= 0; corner = next_corner(ring, &fan))
                ring->node[corner] = h;
        }
    for (int64_t h = 0; h < halves; h++)
        if (ring->across[h] < 0 && ring->border[ring->side[h]]) {
            const int64_t tail = ring->node[h], head = ring->node[next_of(h)];
            ring->loop[tail] = ring->loop[tail] < 0 ? tail : ring->loop[tail];
            ring->loop[head] = ring->loop[head] < 0 ? head : ring->loop[head];
            join_labels(ring->loop, tail, head);
        }
    for (int64_t h = 0; h < halves; h++)
        if (ring->loop[h] >= 0)
            ring->loop[h] = root(ring->loop, h);
}

/* Shorten the distance of a neighbour along a half-edge. */
static void relax(const Ring *ring, Heap *heap, double distance, int64_t half, int64_t other)
{
    const double longer = distance + ring->cost[ring->side[half]];
    if (longer <= ring->limit && longer < ring->distance[other]) {
        ring->distance[other] = longer;
        push(heap, (Entry){longer, other});
    }
}

/* Shorten the distances of the neighbours of a node. */
static void relax_around(const Ring *ring, Heap *heap, Entry here)
{
    Fan fan = {here.node, here.node, 0};
    for (int64_t corner = here.node; corner >= 0; corner = next_corner(ring, &fan)) {
        const int64_t before = previous_of(corner);
        if (ring->across[corner] >= 0 || !ring->border[ring->side[corner]])
            relax(ring, heap, here.distance, corner, ring->node[next_of(corner)]);
        /* Inside, the next triangle of the fan has this edge. */
        if (ring->across[before] < 0 && !ring->border[ring->side[before]])
            relax(ring, heap, here.distance, before, ring->node[before]);
    }
}

/* Write the edges of the cheapest path from a loop to another; their number. */
static int64_t search(const Ring *ring, int64_t halves, int64_t near, int64_t far, Heap *heap, int64_t *path)
{
    int64_t end = -1, length = 0;
    for (int64_t h = 0; h < halves; h++) {
        const int64_t loop = ring->loop[h];
        /* No path leads through nodes on other loops. */
        ring->distance[h] = loop < 0 || loop == far ? INFINITY : loop == near ? 0 : -INFINITY;
        if (loop == near)
            push(heap, (Entry){0, h});
    }
    while (heap->size > 0) {
        const Entry here = pop(heap);
        if (here.distance > ring->distance[here.node])
            continue;
        if (end >= 0 && here.distance > ring->distance[end])
            break;
        if (ring->loop[here.node] == far) {
            if (end < 0)
                end = here.node;
            continue;
        }
        relax_around(ring, heap, here);
    }
    while (end >= 0 && ring->distance[end] > 0 && length < halves) {
        int64_t edge = -1, from = -1;
        Fan fan = {end, end, 0};
        for (int64_t corner = end; corner >= 0; corner = next_corner(ring, &fan)) {
            const int64_t before = previous_of(corner);
            const int64_t sides[2] = {corner, before}, others[2] = {next_of(corner), before};
            for (int k = 0; k < 2; k++) {
                const int64_t number = ring->side[sides[k]], other = ring->node[others[k]];
                if (!ring->border[number] && ring->distance[other] < ring->distance[end]
                    && ring->loop[other] != far && ring->distance[other] + ring->cost[number] == ring->distance[end]
                    && (edge < 0 || number < edge)) {
                    edge = number;
                    from = other;
                }
            }
        }
        if (edge < 0)
            return 0;
        path[length++] = edge;
        end = from;
    }
    return length;
}

/* (opposite, side, border, cost, start, goal, limit, path): the cheapest path across a ring; its number of edges. */
static PyObject *cross_ring(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[8];
    if (!take("cross_ring", given, count, "qqbdnnxQ", a))
        return NULL;
    const Py_ssize_t halves = a[0].size, start = a[4].integer, goal = a[5].integer;
    if (!fit("cross_ring", a, LENGTH(a),
             halves % 3 == 0 && a[1].size == halves && a[2].size == a[3].size && a[7].size == halves && 0 <= start
                 && start < halves && 0 <= goal && goal < halves))
        return NULL;
    int64_t *labels = malloc((size_t)halves * 3 * sizeof(*labels));
    double *distance = malloc((size_t)halves * sizeof(*distance));
    /* Every node is a source at most once, and every edge improves each of its ends at most once. */
    Entry *heap = malloc((size_t)halves * 3 * sizeof(*heap));
    if (!labels || !distance || !heap) {
        free(labels);
        free(distance);
        free(heap);
        return out_of_memory(a, LENGTH(a));
    }
    int64_t length = 0;
    Py_BEGIN_ALLOW_THREADS
    const Ring ring = {a[0].data, a[1].data, a[2].data, a[3].data, labels, labels + halves,
                       labels + 2 * halves, distance, a[6].number};
    label_nodes(&ring, halves);
    const int64_t near = ring.loop[ring.node[start]], far = ring.loop[ring.node[goal]];
    if (near >= 0 && far >= 0 && near != far)
        length = search(&ring, halves, near, far, &(Heap){heap, 0}, a[7].data);
    Py_END_ALLOW_THREADS
    free(labels);
    free(distance);
    free(heap);
    return done_with_integer(a, LENGTH(a), length);
}

/* Edges of cuts around vertices: those of vertex i are at[start[i]], …, at[start[i + 1] - 1]. */
typedef struct {
    const int64_t *ends;
    const uint8_t *on_rim;
    int64_t *start, *at;
} Cuts;

static int is_node(const Cuts *cuts, int64_t vertex)
{
    return cuts->on_rim[vertex] || cuts->start[vertex + 1] - cuts->start[vertex] != 2;
}

static void list_cuts(const Cuts *cuts, Py_ssize_t edges, Py_ssize_t n)
{
    int64_t *start = cuts->start;
    memset(start, 0, (size_t)(n + 1) * sizeof(*start));
    for (Py_ssize_t j = 0; j < 2 * edges; j++)
        start[cuts->ends[j]]++;
    for (Py_ssize_t i = 1; i <= n; i++)
        start[i] += start[i - 1];
    for (Py_ssize_t j = 2 * edges - 1; j >= 0; j--)
        cuts->at[--start[cuts->ends[j]]] = j / 2;
}

/* Walk from a node along an edge to the next node; the number of edges, which are written to `order`. */
static int64_t walk(const Cuts *cuts, int64_t node, int64_t edge, uint8_t *walked, int64_t *order)
{
    int64_t size = 0, here = node;
    for (;;) {
        walked[edge] = 1;
        order[size++] = edge;
        here = cuts->ends[2 * edge] + cuts->ends[2 * edge + 1] - here;
        if (is_node(cuts, here))
            return size;
        const int64_t *at = cuts->at + cuts->start[here];
        edge = at[0] == edge ? at[1] : at[0];
    }
}

/* (ends, on_rim, order, last): the edges of all stretches in order, and where each stretch ends; their number. */
static PyObject *walk_stretches(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[4];
    if (!take("walk_stretches", given, count, "qbQQ", a))
        return NULL;
    const Py_ssize_t edges = a[2].size, n = a[1].size;
    if (!fit("walk_stretches", a, LENGTH(a), a[0].size == 2 * edges && a[3].size == edges))
        return NULL;
    const Cuts cuts = {a[0].data, a[1].data, malloc((size_t)(n + 1) * sizeof(*cuts.start)),
                       malloc((size_t)(2 * edges + 1) * sizeof(*cuts.at))};
    uint8_t *walked = calloc((size_t)edges + 1, 1);
    int64_t *order = a[2].data, *last = a[3].data, size = 0, stretches = 0;
    const int made = cuts.start && cuts.at && walked;
    if (made) {
        Py_BEGIN_ALLOW_THREADS
        list_cuts(&cuts, edges, n);
        for (Py_ssize_t j = 0; j < 2 * edges; j++) {
            const int64_t node = cuts.ends[j];
            if (!is_node(&cuts, node))
                continue;
            for (int64_t k = cuts.start[node]; k < cuts.start[node + 1]; k++)
                if (!walked[cuts.at[k]]) {
                    size += walk(&cuts, node, cuts.at[k], walked, order + size);
                    last[stretches++] = size;
                }
        }
        Py_END_ALLOW_THREADS
    }
    free(cuts.start);
    free(cuts.at);
    free(walked);
    return made ? done_with_integer(a, LENGTH(a), (Py_ssize_t)stretches) : out_of_memory(a, LENGTH(a));
}

PyMethodDef ring_kernels[] = {KERNEL(cross_ring), KERNEL(walk_stretches), END_OF_KERNELS};
