/* What `exact/loops.py` has compiled. */
#include "arguments.h"
#include "predicates.h"

#include <stdlib.h>

/* Edges in a leaf of a tree of boxes. */
#define LEAF 4

typedef struct {
    double low[2], high[2];
} Box;

/* A closed curve: its vertices' places in turn. */
typedef struct {
    const double *uv;
    const int64_t *vertices;
    Py_ssize_t size;
} Curve;

static const double *place(const Curve *curve, Py_ssize_t i)
{
    return curve->uv + 2 * curve->vertices[i < curve->size ? i : 0];
}

static Box edge_box(const Curve *curve, Py_ssize_t i)
{
    const double *p = place(curve, i), *q = place(curve, i + 1);
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

/* Whether an edge may overlap with the one after it: one of them is a point, or the curve may turn right back. */
static int doubtful_turn(const Curve *curve, Py_ssize_t i)
{
    const double *p = place(curve, i), *q = place(curve, i + 1), *beyond = place(curve, i + 1 < curve->size ? i + 2 : 1);
    if (p[0] == q[0] && p[1] == q[1])
        return 1;
    for (int axis = 0; axis < 2; axis++)
        if ((p[axis] < q[axis]) != (beyond[axis] < q[axis]) || (p[axis] > q[axis]) != (beyond[axis] > q[axis]))
            return 0;
    return !sure_orientation(p, q, beyond);
}

/* Whether two edges without common end may meet. */
static int doubtful_pair(const Curve *curve, Py_ssize_t i, Py_ssize_t j)
{
    const double *p = place(curve, i), *q = place(curve, i + 1), *r = place(curve, j), *s = place(curve, j + 1);
    return sure_orientation(p, q, r) * sure_orientation(p, q, s) <= 0 &&
           sure_orientation(r, s, p) * sure_orientation(r, s, q) <= 0;
}

/* A tree of boxes around edges: box 1 around all, boxes 2 k and 2 k + 1 in box k, and the last `width` around LEAF edges
 * each. */
static void grow(const Curve *curve, Box *tree, Py_ssize_t width)
{
    for (Py_ssize_t leaf = 0; leaf < width; leaf++) {
        Box *box = tree + width + leaf;
        *box = (Box){{HUGE_VAL, HUGE_VAL}, {-HUGE_VAL, -HUGE_VAL}};
        for (Py_ssize_t i = LEAF * leaf; i < LEAF * (leaf + 1) && i < curve->size; i++) {
            const Box edge = edge_box(curve, i);
            enlarge(box, &edge);
        }
    }
    for (Py_ssize_t k = width - 1; k > 0; k--) {
        tree[k] = tree[2 * k];
        enlarge(tree + k, tree + 2 * k + 1);
    }
}

/* Pairs of edges that are listed, and how many there may be. */
typedef struct {
    int64_t *pairs;
    Py_ssize_t found, most;
} List;

/* 0 where there is no room left. */
static int add(List *list, Py_ssize_t i, Py_ssize_t j)
{
    if (list->found == list->most)
        return 0;
    list->pairs[2 * list->found] = i;
    list->pairs[2 * list->found + 1] = j;
    list->found++;
    return 1;
}

/* List the doubtful pairs of one curve's edges, which are numbered from `first` on; 0 where there is no room. `tree` is
 * for 2 width boxes. */
static int list_pairs(const Curve *curve, Box *tree, Py_ssize_t width, Py_ssize_t first, List *list)
{
    const Py_ssize_t size = curve->size;
    grow(curve, tree, width);
    for (Py_ssize_t i = 0; i < size; i++) {
        const Box box = edge_box(curve, i);
        /* From box to box, each before those in it; below box k there are `span` of the last ones. */
        for (Py_ssize_t k = 1, span = width; k;) {
            const Py_ssize_t begin = LEAF * (k * span - width);
            const int passed = begin + LEAF * span <= i + 1 || !meet(tree + k, &box);
            if (!passed && k < width) {
                k *= 2;
                span /= 2;
                continue;
            }
            for (Py_ssize_t j = begin > i ? begin : i + 1; !passed && j < begin + LEAF && j < size; j++) {
                int doubtful;
                if (j == i + 1)
                    doubtful = doubtful_turn(curve, i);
                else if (i == 0 && j == size - 1)
                    doubtful = doubtful_turn(curve, j);
                else {
                    const Box other = edge_box(curve, j);
                    doubtful = meet(&other, &box) && doubtful_pair(curve, i, j);
                }
                if (doubtful && !add(list, first + i, first + j))
                    return 0;
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

/* (uv, vertices, starts, pairs): pairs of edges of the same closed curve of which floating point does not say that they
 * have nothing in common but an end that they share; how many there are, or -1 where there are more than there is room
 * for. */
static PyObject *doubtful_pairs(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[4];
    if (!take("doubtful_pairs", given, count, "dqqQ", a))
        return NULL;
    const int64_t *vertices = a[1].data, *starts = a[2].data;
    List list = {a[3].data, 0, a[3].size / 2};
    Py_ssize_t longest = 0, width = 1;
    for (Py_ssize_t g = 0; g + 1 < a[2].size; g++)
        if (starts[g + 1] - starts[g] > longest)
            longest = starts[g + 1] - starts[g];
    while (LEAF * width < longest)
        width *= 2;
    Box *tree = malloc(2 * (size_t)width * sizeof(*tree));
    if (!tree) {
        Py_DECREF(done(a, LENGTH(a)));
        return PyErr_NoMemory();
    }
    int room = 1;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t g = 0; g + 1 < a[2].size && room; g++) {
        const Curve curve = {a[0].data, vertices + starts[g], starts[g + 1] - starts[g]};
        for (width = 1; LEAF * width < curve.size;)
            width *= 2;
        room = list_pairs(&curve, tree, width, starts[g], &list);
    }
    Py_END_ALLOW_THREADS
    free(tree);
    return done_with_integer(a, LENGTH(a), room ? list.found : -1);
}

PyMethodDef loops_kernels[] = {KERNEL(doubtful_pairs), END_OF_KERNELS};
