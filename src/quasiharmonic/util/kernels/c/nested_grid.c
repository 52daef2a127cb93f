/* Kernels of `geometry/exact/point_location.py`: the cells that triangles intersect. */
#include "arguments.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>


/* Pairs of a cell and the number of an entry that meets it. */
typedef struct {
    int64_t *cells, *entries;
    Py_ssize_t count, room;
} Pairs;

static int add(Pairs *pairs, int64_t cell, int64_t entry)
{
    if (pairs->count == pairs->room) {
        const Py_ssize_t room = 2 * pairs->room;
        int64_t *cells = realloc(pairs->cells, (size_t)room * sizeof(int64_t));
        if (cells)
            pairs->cells = cells;
        int64_t *entries = cells ? realloc(pairs->entries, (size_t)room * sizeof(int64_t)) : NULL;
        if (!entries)
            return 0;
        pairs->entries = entries;
        pairs->room = room;
    }
    pairs->cells[pairs->count] = cell;
    pairs->entries[pairs->count++] = entry;
    return 1;
}

/* (low, high, nx, ny, offset, triangle, parent, corner, columns, lines, shift, length, listed): lists by cell, and their
   lengths; how long they are together, and nothing is listed if that is more than there is room for. */
static PyObject *divide_cells(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[13];
    if (!take("divide_cells", given, count, "qqdddqqqnnnQQ", a))
        return NULL;
    const int64_t *low = a[0].data, *high = a[1].data, *triangle = a[5].data, *parent = a[6].data, *corner = a[7].data;
    const double *nx = a[2].data, *ny = a[3].data, *offset = a[4].data;
    const int64_t columns = a[8].integer, lines = a[9].integer;
    const int shift = (int)a[10].integer;
    if (!fit("divide_cells", a, LENGTH(a),
             a[1].size == a[0].size && 2 * a[2].size == 3 * a[0].size && a[3].size == a[2].size &&
             a[4].size == a[2].size && a[6].size == a[5].size && 0 <= shift && shift <= BITS &&
             2 * a[11].size == a[7].size * columns * lines))
        return NULL;
    int64_t *length = a[11].data, *listed = a[12].data;
    const double size = ldexp(1.0, shift - BITS);
    Pairs pairs = {NULL, NULL, 0, 4 * a[5].size + 16};
    pairs.cells = malloc((size_t)pairs.room * sizeof(int64_t));
    pairs.entries = malloc((size_t)pairs.room * sizeof(int64_t));
    int64_t *next = malloc((size_t)(a[11].size + 1) * sizeof(int64_t));
    int enough = pairs.cells && pairs.entries && next;
    if (enough) {
        Py_BEGIN_ALLOW_THREADS
        memset(length, 0, (size_t)a[11].size * sizeof(int64_t));
        for (Py_ssize_t e = 0; e < a[5].size && enough; e++) {
            const int64_t t = triangle[e], *from = corner + 2 * parent[e];
            int64_t first[2], last[2];
            for (int axis = 0; axis < 2; axis++) {
                const int64_t farthest = from[axis] + (axis ? lines : columns) - 1;
                first[axis] = low[2 * t + axis] >> shift;
                last[axis] = high[2 * t + axis] >> shift;
                first[axis] = first[axis] < from[axis] ? from[axis] : first[axis];
                last[axis] = last[axis] > farthest ? farthest : last[axis];
            }
            double reach[3];
            for (int i = 0; i < 3; i++)
                reach[i] = offset[3 * t + i] - (0.5 * size + MARGIN) * (fabs(nx[3 * t + i]) + fabs(ny[3 * t + i])) -
                           UNDERFLOW_MARGIN;
            for (int64_t y = first[1]; y <= last[1] && enough; y++)
                for (int64_t x = first[0]; x <= last[0] && enough; x++) {
                    const double middle_x = ((double)x + 0.5) * size, middle_y = ((double)y + 0.5) * size;
                    int meets = 1;
                    for (int i = 0; i < 3; i++)
                        meets &= middle_x * nx[3 * t + i] + middle_y * ny[3 * t + i] >= reach[i];
                    if (meets) {
                        const int64_t cell = (parent[e] * lines + y - from[1]) * columns + x - from[0];
                        length[cell]++;
                        enough = add(&pairs, cell, e);
                    }
                }
        }
        if (enough && pairs.count <= a[12].size) {
            next[0] = 0;
            for (Py_ssize_t cell = 0; cell < a[11].size; cell++)
                next[cell + 1] = next[cell] + length[cell];
            for (Py_ssize_t k = 0; k < pairs.count; k++)
                listed[next[pairs.cells[k]]++] = triangle[pairs.entries[k]];
        }
        Py_END_ALLOW_THREADS
    }
    const Py_ssize_t together = pairs.count;
    free(pairs.cells);
    free(pairs.entries);
    free(next);
    if (!enough)
        return out_of_memory(a, LENGTH(a));
    return done_with_integer(a, LENGTH(a), together);
}

/* Coordinate of the finest cell; -1 for what is below the unit box, or no number. */
static int64_t finest(double along)
{
    const int64_t last = ((int64_t)1 << BITS) - 1;
    if (!(along >= 0))
        return -1;
    return along < 1 ? (int64_t)(along * 0x1p40) : last;
}

/* (points, columns, shift, parts, cell): the cells that points of the unit box lie in. */
static PyObject *find_cells(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[5];
    if (!take("find_cells", given, count, "dnnqQ", a))
        return NULL;
    const double *points = a[0].data;
    const int64_t columns = a[1].integer, *parts = a[3].data;
    int64_t *cell = a[4].data;
    int inside = 1;
    if (!fit("find_cells", a, LENGTH(a),
             a[0].size == 2 * a[4].size && 0 <= a[2].integer && a[2].integer <= BITS))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < a[4].size && inside; i++) {
        const int64_t x = finest(points[2 * i]), y = finest(points[2 * i + 1]);
        int shift = (int)a[2].integer;
        int64_t at = (y >> shift) * columns + (x >> shift);
        inside = x >= 0 && y >= 0 && at < a[3].size;
        while (inside && parts[at] >= 0) {
            shift -= 2;
            at = parts[at] + ((y >> shift & 3) << 2 | (x >> shift & 3));
        }
        cell[i] = at;
    }
    Py_END_ALLOW_THREADS
    if (!fit("find_cells", a, LENGTH(a), inside))
        return NULL;
    return done(a, LENGTH(a));
}

PyMethodDef nested_grid_kernels[] = {KERNEL(divide_cells), KERNEL(find_cells), END_OF_KERNELS};
