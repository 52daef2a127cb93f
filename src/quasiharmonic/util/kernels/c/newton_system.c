/* Kernels of `energies/newton/newton_system.py`: assembly of the triangles' quadratic forms into a sparse matrix. */
#include "arguments.h"

#include <string.h>

/* Triangles at a time: their blocks stay in the core's first cache, and of each array enough is read at once. */
enum { CHUNK = 256 };

/* What the real and the imaginary part of g1 conj(g2) and of g1 g2 are multiplied by in the entries of a block. */
typedef struct {
    double xx[3][CHUNK], yy[3][CHUNK], cross[3][CHUNK], turn[CHUNK];
} Coefficients;

/* The upper and the lower rows of blocks. */
typedef struct {
    double upper[CHUNK][2], lower[CHUNK][2];
} Blocks;

static void take_coefficients(const Argument *form, Py_ssize_t start, Py_ssize_t size, Coefficients *by)
{
    const double *pp = form[0].data, *qq = form[1].data, *p2 = form[2].data, *q2 = form[3].data;
    const double *pq = form[4].data, *pqc = form[5].data;
    for (Py_ssize_t j = 0; j < size; j++) {
        const Py_ssize_t k = start + j, x = 2 * k, y = x + 1;
        by->xx[0][j] = pp[k] + qq[k] + pq[x];
        by->yy[0][j] = pp[k] + qq[k] - pq[x];
        by->cross[0][j] = -pq[y];
        by->xx[1][j] = pqc[x] + (p2[x] + q2[x]);
        by->yy[1][j] = pqc[x] - (p2[x] + q2[x]);
        by->cross[1][j] = -(p2[y] + q2[y]);
        by->xx[2][j] = pqc[y] + (p2[y] - q2[y]);
        by->yy[2][j] = pqc[y] - (p2[y] - q2[y]);
        by->cross[2][j] = p2[x] - q2[x];
        by->turn[j] = pp[k] - qq[k];
    }
}

/* Blocks between two corners. */
static void take_sides(const Coefficients *by, const double *g1, const double *g2, const double *turns,
                       Py_ssize_t size, Blocks *to)
{
    for (Py_ssize_t j = 0; j < size; j++) {
        const double x1 = g1[2 * j], y1 = g1[2 * j + 1], x2 = g2[2 * j], y2 = g2[2 * j + 1];
        const double xx = x1 * x2, yy = y1 * y2, xy = x1 * y2, yx = y1 * x2;
        const double turned = xx + yy, real = xx - yy, imaginary = xy + yx;
        const double cross = by->cross[0][j] * turned + by->cross[1][j] * real + by->cross[2][j] * imaginary;
        const double turn = turns[j] * by->turn[j] * (yx - xy);
        to->upper[j][0] = by->xx[0][j] * turned + by->xx[1][j] * real + by->xx[2][j] * imaginary;
        to->upper[j][1] = cross - turn;
        to->lower[j][0] = cross + turn;
        to->lower[j][1] = by->yy[0][j] * turned + by->yy[1][j] * real + by->yy[2][j] * imaginary;
    }
}

/* Blocks of corners with themselves; they are symmetric. */
static void take_corners(const Coefficients *by, const double *g, Py_ssize_t size, Blocks *to)
{
    for (Py_ssize_t j = 0; j < size; j++) {
        const double x = g[2 * j], y = g[2 * j + 1], xx = x * x, yy = y * y;
        const double turned = xx + yy, real = xx - yy, imaginary = 2 * (x * y);
        to->upper[j][0] = by->xx[0][j] * turned + by->xx[1][j] * real + by->xx[2][j] * imaginary;
        to->upper[j][1] = by->cross[0][j] * turned + by->cross[1][j] * real + by->cross[2][j] * imaginary;
        to->lower[j][1] = by->yy[0][j] * turned + by->yy[1][j] * real + by->yy[2][j] * imaginary;
    }
}

static void add_pair(const double *from, double *to)
{
    const double first = to[0] + from[0], second = to[1] + from[1];
    to[0] = first;
    to[1] = second;
}

/* (pp, qq, p2, q2, pq, pqc, g, slots, turns, values). */
static PyObject *add_up(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[10];
    if (!take("add_up", given, count, "ddzzzzzidD", a))
        return NULL;
    const double *g = a[6].data, *turns = a[8].data;
    const int32_t *slots = a[7].data;
    double *values = a[9].data;
    const Py_ssize_t f = a[0].size;
    if (!fit("add_up", a, LENGTH(a),
             a[1].size == f && a[2].size == f && a[3].size == f && a[4].size == f && a[5].size == f &&
             a[6].size == 3 * f && a[7].size == 12 * f && a[8].size == 3 * f))
        return NULL;
    Coefficients by;
    Blocks blocks;
    Py_BEGIN_ALLOW_THREADS
    memset(values, 0, sizeof(double) * (size_t)a[9].size);
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        const Py_ssize_t size = f - start < CHUNK ? f - start : CHUNK;
        take_coefficients(a, start, size, &by);
        for (int corner = 0; corner < 3; corner++) {
            const double *here = g + 2 * (corner * f + start), *next = g + 2 * ((corner + 1) % 3 * f + start);
            const int32_t *upper = slots + corner * f + start, *lower = upper + 3 * f;
            take_sides(&by, here, next, turns + corner * f + start, size, &blocks);
            for (Py_ssize_t j = 0; j < size; j++) {
                add_pair(blocks.upper[j], values + upper[j]);
                add_pair(blocks.lower[j], values + lower[j]);
            }
            upper += 6 * f;
            lower += 6 * f;
            take_corners(&by, here, size, &blocks);
            for (Py_ssize_t j = 0; j < size; j++) {
                add_pair(blocks.upper[j], values + upper[j]);
                values[lower[j] + 1] += blocks.lower[j][1];
            }
        }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef newton_system_kernels[] = {KERNEL(add_up), END_OF_KERNELS};
