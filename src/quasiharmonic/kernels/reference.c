/* What `mesh/reference.py` has compiled. */
#include "arguments.h"

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

PyMethodDef reference_kernels[] = {KERNEL(wirtinger), END_OF_KERNELS};
