/* Kernels of `energies/newton/distant_starts.py`. */
#include "arguments.h"

#include <math.h>

/* As `_factor` there. */
static double factor(double sigma, double aim)
{
    const double rigid = 2 * (sigma + 1) * (sigma * sigma + 1) / (sigma * sigma * sigma);
    const double held = sigma < 1 ? (aim - 1) * sigma : (1 - 1 / aim) * sigma;
    const double further = fabs(sigma - 1) / held;
    /* Of a NaN it makes a NaN. */
    return rigid * (further <= 1 ? 1 : further);
}

/* 1/x, and 0 at 0; not by a jump. */
static double inverse(double x)
{
    const double divided = 1 / (x > 0 ? x : 1);
    return x > 0 ? divided : 0;
}

/* (p, q, det, aim, both, mixed). */
static PyObject *rigid_proxies(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("rigid_proxies", given, count, "zzdxDZ", a))
        return NULL;
    const double *p = a[0].data, *q = a[1].data, *det = a[2].data, aim = a[3].number;
    double *both = a[4].data, *mixed = a[5].data;
    if (!fit("rigid_proxies", a, LENGTH(a),
             a[0].size == a[2].size && a[1].size == a[2].size && a[4].size == a[2].size && a[5].size == a[2].size))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < a[2].size; j++) {
        const double px = p[2 * j], py = p[2 * j + 1], qx = q[2 * j], qy = q[2 * j + 1];
        const double size_p = sqrt(px * px + py * py), size_q = sqrt(qx * qx + qy * qy), larger = size_p + size_q;
        const double k1 = factor(larger, aim), k2 = factor(det[j] / larger, aim);
        const double turn = 2 * (k1 - k2) * inverse(size_p) * inverse(size_q);
        both[j] = k1 + k2;
        mixed[2 * j] = turn * (px * qx - py * qy);
        mixed[2 * j + 1] = -turn * (px * qy + py * qx);
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef reweighted_kernels[] = {KERNEL(rigid_proxies), END_OF_KERNELS};
