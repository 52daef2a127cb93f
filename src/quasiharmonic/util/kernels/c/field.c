/* Kernels of `solver/field/objective.py`: stiffness of a tensor field, and V3 with its gradient in xi. */
#include "arguments.h"

#include <float.h>
#include <math.h>

/* Sums are taken over so many triangles at a time before they are added up, which keeps rounding small. */
#define TOGETHER 1024

/* r/rho, 1/(1 - r^2) and r' of the sigmoid of this number in `field/tensor.py`. */
typedef struct {
    double ratio, by_defect, slope;
} Radial;

static Radial tanh_at(double rho)
{
    Radial at;
    double less, decay; /* 1 - exp(-2 rho) and exp(-2 rho), each from whichever of the two is accurate */
    if (rho < 0.35) {
        less = -expm1(-2.0 * rho);
        decay = 1.0 - less;
    } else {
        decay = exp(-2.0 * rho);
        less = 1.0 - decay;
    }
    const double more = 1.0 + decay;
    at.ratio = rho > TINY ? less / (more * rho) : 1.0;
    at.by_defect = 0.25 * more * more / decay;
    at.slope = 4.0 * decay / (more * more);
    return at;
}

static Radial si_log_at(double rho)
{
    Radial at;
    const double grown = log1p(rho), omega = 1.0 / (1.0 + grown);
    at.ratio = rho > 0 ? grown * omega / (rho > TINY ? rho : TINY) : 1.0;
    at.by_defect = 1.0 / (omega * (2.0 - omega));
    at.slope = omega * omega / (1.0 + rho);
    return at;
}

static Radial radial_at(Py_ssize_t number, double rho)
{
    return number ? si_log_at(rho) : tanh_at(rho);
}

/* (xi, number, by_entry, stiffness): edge stiffness of tensors, (3, f). */
static PyObject *fill_stiffness(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[4];
    if (!take("fill_stiffness", given, count, "zn~dD", a))
        return NULL;
    const double *xi = a[0].data, *by_entry = a[2].data;
    const Py_ssize_t number = a[1].integer, f = a[0].size, step = a[2].stride, row = a[2].row_stride;
    double *stiffness = a[3].data;
    if (!fit("fill_stiffness", a, LENGTH(a),
             a[2].rows == 9 && a[2].columns == f && a[3].size == 3 * f))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < f; j++) {
        const double x = xi[2 * j], y = xi[2 * j + 1];
        const Radial at = radial_at(number, sqrt(x * x + y * y));
        const double twice = 2.0 * at.by_defect, c = twice - 1.0, real = twice * at.ratio * x;
        const double a11 = c - real, a12 = -(twice * at.ratio * y), a22 = c + real;
        const double *k = by_entry + j * step;
        for (int edge = 0; edge < 3; edge++, k += 3 * row)
            stiffness[edge * f + j] = k[0] * a11 + k[row] * a12 + k[2 * row] * a22;
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* (w, F, half_gamma, m, xi, number, starts, gradient, sums): the gradient of V3 in xi, and of each mesh how many
   triangles are not positive, V3, the signed and the unsigned area. */
static PyObject *dirichlet_sweep(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[9];
    if (!take("dirichlet_sweep", given, count, "zq~z~dznqZD", a))
        return NULL;
    const double *w = a[0].data, *gamma = a[2].data, *m = a[3].data, *xi = a[4].data;
    const int64_t *F = a[1].data, *starts = a[6].data;
    const Py_ssize_t number = a[5].integer, step = 2 * a[2].stride, row = 2 * a[2].row_stride, by = a[3].stride;
    const Py_ssize_t f = a[4].size, meshes = a[6].size - 1;
    double *gradient = a[7].data, *sums = a[8].data;
    if (!fit("dirichlet_sweep", a, LENGTH(a),
             a[1].size == 3 * f && a[2].rows == 2 && a[2].columns == f && a[3].rows == 1 && a[3].columns == f &&
             are_parts(a + 6, f) && a[7].size == f && a[8].size == 4 * meshes))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < meshes; i++) {
        double *sum = sums + 4 * i;
        sum[0] = sum[1] = sum[2] = sum[3] = 0.0;
        for (Py_ssize_t begin = starts[i]; begin < starts[i + 1]; begin += TOGETHER) {
            const Py_ssize_t end = begin + TOGETHER < starts[i + 1] ? begin + TOGETHER : (Py_ssize_t)starts[i + 1];
            double energy = 0.0, area = 0.0, unsigned_area = 0.0;
            for (Py_ssize_t j = begin; j < end; j++) {
                const double *w0 = w + 2 * F[3 * j], *w1 = w + 2 * F[3 * j + 1], *w2 = w + 2 * F[3 * j + 2];
                const double x1 = w1[0] - w0[0], y1 = w1[1] - w0[1], x2 = w2[0] - w0[0], y2 = w2[1] - w0[1];
                const double image = 0.5 * (x1 * y2 - y1 * x2);
                sum[0] += !(image > 0);
                area += image;
                unsigned_area += fabs(image);
                /* As of `wirtinger`. */
                const double *g1 = gamma + j * step, *g2 = g1 + row;
                const double pr = (x1 * g1[0] + y1 * g1[1]) + (x2 * g2[0] + y2 * g2[1]);
                const double pi = (y1 * g1[0] - x1 * g1[1]) + (y2 * g2[0] - x2 * g2[1]);
                const double qr = (x1 * g1[0] - y1 * g1[1]) + (x2 * g2[0] - y2 * g2[1]);
                const double qi = (x1 * g1[1] + y1 * g1[0]) + (x2 * g2[1] + y2 * g2[0]);
                const double x = xi[2 * j], y = xi[2 * j + 1], square = x * x + y * y;
                const Radial at = radial_at(number, sqrt(square));
                const double u = at.ratio * x, v = at.ratio * y; /* mu */
                /* q - mu p, and conj(p) - mu conj(q). */
                const double rr = qr - (u * pr - v * pi), ri = qi - (u * pi + v * pr);
                const double sr = pr - (u * qr + v * qi), si = -pi - (v * qr - u * qi);
                const double weight = m[j * by] * at.by_defect, scale = -4.0 * (weight * at.by_defect);
                energy += (rr * rr + ri * ri) * weight;
                const double gr = scale * (rr * sr - ri * si), gi = scale * (rr * si + ri * sr);
                /* As of `TensorField.pull`. */
                const double along = (at.slope - at.ratio) / (square > TINY ? square : TINY) * (x * gr + y * gi);
                gradient[2 * j] = at.ratio * gr + along * x;
                gradient[2 * j + 1] = at.ratio * gi + along * y;
            }
            sum[1] += 2.0 * energy;
            sum[2] += area;
            sum[3] += unsigned_area;
        }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* (w, F, half_gamma, m, starts, mu, sums): each triangle's own mu, as far as the bound of tanh's xi allows, and of each
   mesh V3 at these, and the signed area. */
static PyObject *at_own_tensors(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[7];
    if (!take("at_own_tensors", given, count, "zq~z~dqZD", a))
        return NULL;
    const double *w = a[0].data, *gamma = a[2].data, *m = a[3].data;
    const int64_t *F = a[1].data, *starts = a[4].data;
    const Py_ssize_t step = 2 * a[2].stride, row = 2 * a[2].row_stride, by = a[3].stride;
    const Py_ssize_t f = a[5].size, meshes = a[4].size - 1;
    const double most = tanh(TANH_BOUND);
    double *mu = a[5].data, *sums = a[6].data;
    if (!fit("at_own_tensors", a, LENGTH(a),
             a[1].size == 3 * f && a[2].rows == 2 && a[2].columns == f && a[3].rows == 1 && a[3].columns == f &&
             are_parts(a + 4, f) && a[6].size == 2 * meshes))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < meshes; i++) {
        double energy = 0.0, area = 0.0;
        for (Py_ssize_t j = (Py_ssize_t)starts[i]; j < starts[i + 1]; j++) {
            const double *w0 = w + 2 * F[3 * j], *w1 = w + 2 * F[3 * j + 1], *w2 = w + 2 * F[3 * j + 2];
            const double x1 = w1[0] - w0[0], y1 = w1[1] - w0[1], x2 = w2[0] - w0[0], y2 = w2[1] - w0[1];
            area += 0.5 * (x1 * y2 - y1 * x2);
            /* As of `wirtinger`. */
            const double *g1 = gamma + j * step, *g2 = g1 + row;
            const double pr = (x1 * g1[0] + y1 * g1[1]) + (x2 * g2[0] + y2 * g2[1]);
            const double pi = (y1 * g1[0] - x1 * g1[1]) + (y2 * g2[0] - x2 * g2[1]);
            const double qr = (x1 * g1[0] - y1 * g1[1]) + (x2 * g2[0] - y2 * g2[1]);
            const double qi = (x1 * g1[1] + y1 * g1[0]) + (x2 * g2[1] + y2 * g2[0]);
            /* As of `own_tensor`: q / p, or conj(p / q) where that is less. Sizes by `hypot`, as in NumPy. */
            const double size_p = hypot(pr, pi), size_q = hypot(qr, qi);
            const int inverted = size_q > size_p;
            const double large = inverted ? size_q : size_p;
            const double nr = inverted ? pr : qr, ni = inverted ? -pi : qi;
            /* Of modulus one, so that no square leaves the range. */
            const double dr = (inverted ? qr : pr) / large, di = (inverted ? -qi : pi) / large;
            double u = 0.0, v = 0.0;
            if (large >= DBL_MIN) {
                u = (nr / large) * dr + (ni / large) * di;
                v = (ni / large) * dr - (nr / large) * di;
            }
            const double modulus = sqrt(u * u + v * v);
            double by_defect = 1.0 / ((1.0 - modulus) * (1.0 + modulus));
            if (!(modulus <= most)) {
                u *= most / modulus;
                v *= most / modulus;
                by_defect = tanh_at(TANH_BOUND).by_defect;
            }
            mu[2 * j] = u;
            mu[2 * j + 1] = v;
            const double rr = qr - (u * pr - v * pi), ri = qi - (u * pi + v * pr);
            energy += (rr * rr + ri * ri) * m[j * by] * by_defect;
        }
        sums[2 * i] = 2.0 * energy;
        sums[2 * i + 1] = area;
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* (xi, bound): clip moduli in place. */
static PyObject *clip_moduli(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[2];
    if (!take("clip_moduli", given, count, "Zx", a))
        return NULL;
    double *xi = a[0].data;
    const double bound = a[1].number, most = bound * bound;
    for (Py_ssize_t j = 0; j < a[0].size; j++) {
        const double square = xi[2 * j] * xi[2 * j] + xi[2 * j + 1] * xi[2 * j + 1];
        if (square > most) {
            const double by = bound / sqrt(square);
            xi[2 * j] *= by;
            xi[2 * j + 1] *= by;
        }
    }
    return done(a, LENGTH(a));
}

PyMethodDef field_kernels[] = {
    KERNEL(fill_stiffness),
    KERNEL(dirichlet_sweep),
    KERNEL(at_own_tensors),
    KERNEL(clip_moduli),
    END_OF_KERNELS,
};
