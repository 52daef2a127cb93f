/* Kernels of `geometry/exact/loops.py`. */
#include "arguments.h"
#include "predicates.h"

#include <stdlib.h>

/* Segments in a leaf of a tree of boxes. */
#define LEAF 4

typedef struct {
    double low[2], high[2];
} Box;

/* Segments between places: the numbers of their ends. */
typedef struct {
    const double *places;
    const int64_t *tails, *heads;
    Py_ssize_t size;
} Segments;

static const double *tail(const Segments *of, Py_ssize_t i)
{
    return of->places + 2 * of->tails[i];
}

static const double *head(const Segments *of, Py_ssize_t i)
{
    return of->places + 2 * of->heads[i];
}

static Box box_of(const Segments *of, Py_ssize_t i)
{
    const double *p = tail(of, i), *q = head(of, i);
    Box box;
    for (int axis = 0; axis < 2; axis++) {
        box.low[axis] = p[axis] < q[axis] ? p[axis] : q[axis];
        box.high[axis] = p[axis] > q[axis] ? p[axis] : q[axis];
    }
    return box;
}

static int meet(const Box *one, const Box *other)
{
    return one->low[0] <= other->high[0] && other->low[0] <= one->high[0] && one->low[1] <= other->high[1] &&
           other->low[1] <= one->high[1];
}

static void enlarge(Box *box, const Box *by)
{
    for (int axis = 0; axis < 2; axis++) {
        if (by->low[axis] < box->low[axis])
            box->low[axis] = by->low[axis];
        if (by->high[axis] > box->high[axis])
            box->high[axis] = by->high[axis];
    }
}

static int same_place(const double *one, const double *other)
{
    return one[0] == other[0] && one[1] == other[1];
}

/* Whether segments from one place to two others may overlap: one of them is a point, or they may run the same way. */
static int doubtful_overlap(const double *from, const double *one, const double *other)
{
    if (same_place(from, one) || same_place(from, other))
        return 1;
    for (int axis = 0; axis < 2; axis++)
        if ((one[axis] < from[axis]) != (other[axis] < from[axis]) || (one[axis] > from[axis]) != (other[axis] > from[axis]))
            return 0;
    return !sure_orientation(one, from, other);
}

/* Whether two segments may have more in common than an end that they share. */
static int doubtful(const Segments *of, Py_ssize_t i, Py_ssize_t j)
{
    const double *p = tail(of, i), *q = head(of, i), *r = tail(of, j), *s = head(of, j);
    const int tails = of->tails[i] == of->tails[j], heads = of->heads[i] == of->heads[j];
    const int ahead = of->heads[i] == of->tails[j], behind = of->tails[i] == of->heads[j];
    if (tails + heads + ahead + behind > 1)
        return 1;
    if (tails || behind)
        return doubtful_overlap(p, q, tails ? s : r);
    if (heads || ahead)
        return doubtful_overlap(q, p, heads ? r : s);
    return sure_orientation(p, q, r) * sure_orientation(p, q, s) <= 0 &&
           sure_orientation(r, s, p) * sure_orientation(r, s, q) <= 0;
}

/* A tree of boxes around segments: box 1 around all, boxes 2 k and 2 k + 1 in box k, and the last `width` around LEAF
 * segments each. */
static void grow(const Segments *of, Box *tree, Py_ssize_t width)
{
    for (Py_ssize_t leaf = 0; leaf < width; leaf++) {
        Box *box = tree + width + leaf;
        *box = (Box){{HUGE_VAL, HUGE_VAL}, {-HUGE_VAL, -HUGE_VAL}};
        for (Py_ssize_t i = LEAF * leaf; i < LEAF * (leaf + 1) && i < of->size; i++) {
            const Box one = box_of(of, i);
            enlarge(box, &one);
        }
    }
    for (Py_ssize_t k = width - 1; k > 0; k--) {
        tree[k] = tree[2 * k];
        enlarge(tree + k, tree + 2 * k + 1);
    }
}

/* Pairs of segments that are listed, and how many there may be. */
typedef struct {
    int64_t *pairs;
    Py_ssize_t found, most;
} List;

/* List the doubtful pairs of one group of segments, the first of which has the number `first`; 0 where there is no room.
 * `tree` is for 2 width boxes. */
static int list_pairs(const Segments *of, Box *tree, Py_ssize_t width, Py_ssize_t first, List *list)
{
    grow(of, tree, width);
    for (Py_ssize_t i = 0; i < of->size; i++) {
        const Box box = box_of(of, i);
        /* From box to box, each before those in it; below box k there are `span` of the last ones. */
        for (Py_ssize_t k = 1, span = width; k;) {
            const Py_ssize_t begin = LEAF * (k * span - width);
            const int passed = begin + LEAF * span <= i + 1 || !meet(tree + k, &box);
            if (!passed && k < width) {
                k *= 2;
                span /= 2;
                continue;
            }
            for (Py_ssize_t j = begin > i ? begin : i + 1; !passed && j < begin + LEAF && j < of->size; j++) {
                const Box other = box_of(of, j);
                if (!meet(&other, &box) || !doubtful(of, i, j))
                    continue;
                if (list->found == list->most)
                    return 0;
                list->pairs[2 * list->found] = first + i;
                list->pairs[2 * list->found + 1] = first + j;
                list->found++;
            }
            while (k % 2) {
                k /= 2;
                span *= 2;
            }
            k += k > 0;
        }
    }
    return 1;
}

/* As many leaves as it takes, a power of two. */
static Py_ssize_t leaves(Py_ssize_t segments)
{
    Py_ssize_t width = 1;
    while (LEAF * width < segments)
        width *= 2;
    return width;
}

/* (places, tails, heads, starts, pairs): pairs of segments of the same group of which floating point does not say that
 * they have nothing in common but an end that they share; how many there are, or -1 where there are more than there is
 * room for. */
static PyObject *doubtful_pairs(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[5];
    if (!take("doubtful_pairs", given, count, "dqqqQ", a))
        return NULL;
    const int64_t *tails = a[1].data, *heads = a[2].data, *starts = a[3].data;
    List list = {a[4].data, 0, a[4].size / 2};
    if (!fit("doubtful_pairs", a, LENGTH(a),
             a[2].size == a[1].size && are_indices(a + 1, a[0].size / 2) && are_indices(a + 2, a[0].size / 2) &&
             are_parts(a + 3, a[1].size)))
        return NULL;
    Py_ssize_t largest = 0;
    for (Py_ssize_t g = 0; g + 1 < a[3].size; g++)
        if (starts[g + 1] - starts[g] > largest)
            largest = starts[g + 1] - starts[g];
    Box *tree = malloc(2 * (size_t)leaves(largest) * sizeof(*tree));
    if (!tree)
        return out_of_memory(a, LENGTH(a));
    int room = 1;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t g = 0; g + 1 < a[3].size && room; g++) {
        const Segments group = {a[0].data, tails + starts[g], heads + starts[g], starts[g + 1] - starts[g]};
        room = list_pairs(&group, tree, leaves(group.size), starts[g], &list);
    }
    Py_END_ALLOW_THREADS
    free(tree);
    return done_with_integer(a, LENGTH(a), room ? list.found : -1);
}

PyMethodDef loops_kernels[] = {KERNEL(doubtful_pairs), END_OF_KERNELS};
