/* Kernels of `apps/atlas/packing/board.py` that draw shapes. */
#include "arguments.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    double x, y;
} Point;

/* A row or column: the number itself where it is one of so many, else the nearest; 0 for NaN. */
static int64_t clipped(double value, Py_ssize_t most)
{
    return value > 0 ? value < (double)most ? (int64_t)value : most : 0;
}

/* Cut off the part of a parameter's range [range[0], range[1]] in which start + parameter * along is outside of [low, high]. */
static void clip(double start, double along, double low, double high, double range[2])
{
    const double one = (low - start) / along, other = (high - start) / along;
    if (along == 0) {
        if (!(start >= low && start <= high))
            range[1] = -1;
        return;
    }
    range[0] = fmax(range[0], fmin(one, other));
    range[1] = fmin(range[1], fmax(one, other));
}

/* (tails, heads, cells): the cells around whose centres edges wind. */
static PyObject *fill_cells(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("fill_cells", given, count, "zzB", a))
        return NULL;
    const Point *tails = a[0].data, *heads = a[1].data;
    uint8_t *cells = a[2].data;
    const Py_ssize_t h = a[2].rows, w = a[2].columns;
    if (!fit("fill_cells", a, LENGTH(a), a[1].size == a[0].size))
        return NULL;
    int64_t *change = calloc((size_t)(h * (w + 1)) + 1, sizeof(*change));
    if (!change)
        return out_of_memory(a, LENGTH(a));
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t e = 0; e < a[0].size; e++) {
        const int up = heads[e].y > tails[e].y;
        const Point lower = up ? tails[e] : heads[e], upper = up ? heads[e] : tails[e];
        const int64_t end = clipped(ceil(upper.y - 0.5), h);
        const double slope = (upper.x - lower.x) / (upper.y - lower.y);
        for (int64_t row = clipped(ceil(lower.y - 0.5), h); row < end; row++) {
            const double x = lower.x + ((double)row + 0.5 - lower.y) * slope;
            change[row * (w + 1) + clipped(ceil(x - 0.5), w)] += up ? 1 : -1;
        }
    }
    for (Py_ssize_t i = 0; i < h; i++)
        for (int64_t j = 0, winding = 0; j < w; j++) {
            winding += change[i * (w + 1) + j];
            cells[i * w + j] = winding != 0;
        }
    Py_END_ALLOW_THREADS
    free(change);
    return done(a, LENGTH(a));
}

/* (tails, heads, radius, spacing, cells): mark the cells whose centres are within a distance of an edge; edges of 2^31
 * samples or more, or that are not finite, mark none. */
static PyObject *mark_near(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[5];
    if (!take("mark_near", given, count, "zzxxB", a))
        return NULL;
    const Point *tails = a[0].data, *heads = a[1].data;
    uint8_t *cells = a[4].data;
    const double radius = a[2].number, spacing = a[3].number;
    const int64_t h = a[4].rows, w = a[4].columns;
    if (!fit("mark_near", a, LENGTH(a), a[1].size == a[0].size && radius >= 0 && radius < INT32_MAX && spacing > 0))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    /* Every point of an edge is at most half the spacing from a sample. */
    const double reach = radius * radius + spacing * spacing / 4;
    const int64_t k = (int64_t)sqrt(reach) + 2;
    for (Py_ssize_t e = 0; e < a[0].size; e++) {
        const double dx = heads[e].x - tails[e].x, dy = heads[e].y - tails[e].y;
        const double samples = fmax(ceil(hypot(dx, dy) / spacing), 1);
        double range[2] = {0, 1};
        clip(tails[e].x, dx, (double)-k, (double)(w + k), range);
        clip(tails[e].y, dy, (double)-k, (double)(h + k), range);
        if (!(samples < INT32_MAX && range[0] <= range[1]))
            continue;
        /* One sample more at both ends, because of rounding. */
        const int64_t last = clipped(ceil(range[1] * samples) + 1, (Py_ssize_t)samples - 1);
        for (int64_t s = clipped(floor(range[0] * samples) - 1, (Py_ssize_t)samples - 1); s <= last; s++) {
            const double part = (double)s / samples, x = tails[e].x + dx * part, y = tails[e].y + dy * part;
            if (!(x > (double)-k && x < (double)(w + k) && y > (double)-k && y < (double)(h + k)))
                continue;
            const int64_t i = (int64_t)floor(y), j = (int64_t)floor(x);
            for (int64_t di = 1 - k; di < k; di++) {
                if (i + di < 0 || i + di >= h)
                    continue;
                const double high = (double)di + 0.5 - (y - (double)i);
                for (int64_t dj = 1 - k; dj < k; dj++) {
                    const double across = (double)dj + 0.5 - (x - (double)j);
                    if (j + dj >= 0 && j + dj < w && high * high + across * across <= reach)
                        cells[(i + di) * w + j + dj] = 1;
                }
            }
        }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef drawing_kernels[] = {KERNEL(fill_cells), KERNEL(mark_near), END_OF_KERNELS};
