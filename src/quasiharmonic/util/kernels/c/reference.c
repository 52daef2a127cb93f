/* Kernels of `geometry/mesh/reference.py`. */
#include "arguments.h"

#include <math.h>

/* (w, F, half_gamma, p, q, area): Wirtinger derivatives of a map and signed areas of the images, by triangle. */
static PyObject *wirtinger(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("wirtinger", given, count, "zq~zZZD", a))
        return NULL;
    const double *w = a[0].data, *gamma = a[2].data;
    const int64_t *F = a[1].data;
    double *p = a[3].data, *q = a[4].data, *area = a[5].data;
    const Py_ssize_t f = a[5].size, step = 2 * a[2].stride, row = 2 * a[2].row_stride;
    if (!fit("wirtinger", a, LENGTH(a),
             a[1].size == 3 * f && a[2].rows == 2 && a[2].columns == f && a[3].size == f && a[4].size == f))
        return NULL;
    for (Py_ssize_t j = 0; j < f; j++) {
        const double *w0 = w + 2 * F[3 * j], *w1 = w + 2 * F[3 * j + 1], *w2 = w + 2 * F[3 * j + 2];
        const double x1 = w1[0] - w0[0], y1 = w1[1] - w0[1], x2 = w2[0] - w0[0], y2 = w2[1] - w0[1];
        const double *g1 = gamma + j * step, *g2 = g1 + row;
        p[2 * j] = (x1 * g1[0] + y1 * g1[1]) + (x2 * g2[0] + y2 * g2[1]);
        p[2 * j + 1] = (y1 * g1[0] - x1 * g1[1]) + (y2 * g2[0] - x2 * g2[1]);
        q[2 * j] = (x1 * g1[0] - y1 * g1[1]) + (x2 * g2[0] - y2 * g2[1]);
        q[2 * j + 1] = (x1 * g1[1] + y1 * g1[0]) + (x2 * g2[1] + y2 * g2[0]);
        area[j] = 0.5 * (x1 * y2 - y1 * x2);
    }
    return done(a, LENGTH(a));
}

/* A power of two as two factors, one of them 1 wherever it is a double itself. */
typedef struct {
    double most, rest;
} Power;

static Power power_of_two(Py_ssize_t exponent)
{
    const int most = exponent > 1000 ? 1000 : (int)exponent;
    return (Power){ldexp(1, most), ldexp(1, (int)exponent - most)};
}

static double dot(const double *a, const double *b, Py_ssize_t dimension)
{
    double sum = a[0] * b[0] + a[1] * b[1];
    if (dimension == 3)
        sum += a[2] * b[2];
    return sum;
}

/* (V, F, exponent, z1, z2): triangles laid into the plane, computed in units of 2^exponent; how many have no area. */
static PyObject *lay_flat(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[5];
    if (!take("lay_flat", given, count, "~dqnDZ", a))
        return NULL;
    const double *V = a[0].data;
    const int64_t *F = a[1].data;
    double *z1 = a[3].data, *z2 = a[4].data;
    const Py_ssize_t f = a[3].size, dimension = a[0].columns, row = a[0].row_stride, step = a[0].stride;
    if (!fit("lay_flat", a, LENGTH(a),
             (dimension == 2 || dimension == 3) && a[1].size == 3 * f && a[4].size == f))
        return NULL;
    const Power into = power_of_two(-a[2].integer), back = power_of_two(a[2].integer);
    Py_ssize_t flat = 0;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < f; j++) {
        double corner[3][3], one[3] = {0}, other[3] = {0};
        for (int i = 0; i < 3; i++)
            for (Py_ssize_t axis = 0; axis < dimension; axis++)
                corner[i][axis] = V[F[3 * j + i] * row + axis * step] * into.most * into.rest;
        for (Py_ssize_t axis = 0; axis < dimension; axis++) {
            one[axis] = corner[1][axis] - corner[0][axis];
            other[axis] = corner[2][axis] - corner[0][axis];
        }
        const double length = sqrt(dot(one, one, dimension));
        double across = one[0] * other[1] - one[1] * other[0];
        if (dimension == 3) {
            const double normal[] = {across, one[1] * other[2] - one[2] * other[1], one[2] * other[0] - one[0] * other[2]};
            across = sqrt(dot(normal, normal, 3));
        }
        /* Where vertices 0 and 1 coincide any direction is as good as another. */
        const double along = length > 0 ? dot(one, other, dimension) : sqrt(dot(other, other, dimension));
        const double by = length > 0 ? length : 1;
        z1[j] = length * back.most * back.rest;
        z2[2 * j] = along / by * back.most * back.rest;
        z2[2 * j + 1] = across / by * back.most * back.rest;
        flat += z1[j] == 0 || z2[2 * j + 1] == 0;
    }
    Py_END_ALLOW_THREADS
    return done_with_integer(a, LENGTH(a), flat);
}

PyMethodDef reference_kernels[] = {KERNEL(lay_flat), KERNEL(wirtinger), END_OF_KERNELS};
