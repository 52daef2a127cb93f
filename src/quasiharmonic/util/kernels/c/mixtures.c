/* Kernels of `energies/deformation.py`: sums of the library's isotropic energies, in a = |p|^2 and b = |q|^2. A sum E
   can be hardened to E + k E^3, continued by its tangent where E is large. */
#include "arguments.h"

#include <math.h>
#include <string.h>

/* Triangles at a time: what is in between stays in the core's first cache, and is made by loops without jumps. */
enum { CHUNK = 128 };

/* The order of `TERMS`, the factor k, and the E from which the tangent is used. */
enum { MIPS, SYMMETRIC_DIRICHLET, ARAP, AREA_BARRIER, CUBE, LINEAR_FROM, NUMBERS };

typedef struct {
    Py_ssize_t size;
    double a[CHUNK], b[CHUNK], det[CHUNK];
} Squares;

typedef struct {
    double a[CHUNK], b[CHUNK];
} Slopes;

typedef struct {
    double aa[CHUNK], ab[CHUNK], bb[CHUNK];
} Bends;

static void take_squares(const double *p, const double *q, const double *det, Py_ssize_t start, Py_ssize_t f,
                         Squares *d)
{
    d->size = f - start < CHUNK ? f - start : CHUNK;
    p += 2 * start;
    q += 2 * start;
    det += start;
    for (Py_ssize_t j = 0; j < d->size; j++) {
        d->a[j] = p[2 * j] * p[2 * j] + p[2 * j + 1] * p[2 * j + 1];
        d->b[j] = q[2 * j] * q[2 * j] + q[2 * j + 1] * q[2 * j + 1];
        d->det[j] = det[j];
    }
}

/* NaN where there is no barrier energy, as the derivatives want it. */
static double positive(double det)
{
    return det > 0 ? det : NAN;
}

static void add_densities(const double *mixture, const Squares *d, double *density)
{
    const Py_ssize_t size = d->size;
    const double *a = d->a, *b = d->b, *det = d->det;
    double c = mixture[MIPS];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double value = 4 * b[j] / det[j];
            density[j] += c * (det[j] > 0 ? value : INFINITY);
        }
    c = mixture[SYMMETRIC_DIRICHLET];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double apart = det[j] - 1, inverse = 1 / det[j];
            const double value = 2 * (apart * apart) * inverse + 4 * b[j] * (1 + inverse * inverse);
            density[j] += c * (det[j] > 0 ? value : INFINITY);
        }
    c = mixture[ARAP];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double apart = sqrt(a[j]) - 1;
            density[j] += c * (2 * (apart * apart) + 2 * b[j]);
        }
    c = mixture[AREA_BARRIER];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double apart = det[j] - 1, value = apart * apart / det[j];
            density[j] += c * (det[j] > 0 ? value : INFINITY);
        }
}

static void take_densities(const double *mixture, const Squares *d, double *density)
{
    const double k = mixture[CUBE], linear_from = mixture[LINEAR_FROM];
    memset(density, 0, CHUNK * sizeof *density);
    add_densities(mixture, d, density);
    if (k != 0)
        for (Py_ssize_t j = 0; j < d->size; j++) {
            const double e = density[j], least = e > linear_from ? linear_from : e;
            const double tangent = 3 * k * (least * least) * (e - linear_from);
            density[j] = e + k * (least * least * least) + (e > linear_from ? tangent : 0);
        }
}

static void add_slopes(const double *mixture, const Squares *d, Slopes *slopes)
{
    const Py_ssize_t size = d->size;
    const double *a = d->a, *b = d->b, *det = d->det;
    double *by_a = slopes->a, *by_b = slopes->b;
    double c = mixture[MIPS];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double D = positive(det[j]), scale = c * 4 / (D * D);
            by_a[j] -= scale * b[j];
            by_b[j] += scale * a[j];
        }
    c = mixture[SYMMETRIC_DIRICHLET];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double inverse = 1 / positive(det[j]), square = inverse * inverse;
            const double shear = 8 * b[j] * (square * inverse);
            by_a[j] += c * (2 - 2 * square - shear);
            by_b[j] += c * (2 + 6 * square + shear);
        }
    c = mixture[ARAP];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double root = sqrt(a[j]), inverse = 1 / (root > 0 ? root : 1);
            by_a[j] += c * (2 - 2 * (root > 0 ? inverse : 0));
            by_b[j] += c * 2;
        }
    c = mixture[AREA_BARRIER];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double D = positive(det[j]), slope = c * (1 - 1 / (D * D));
            by_a[j] += slope;
            by_b[j] -= slope;
        }
}

static void add_bends(const double *mixture, const Squares *d, Bends *bends)
{
    const Py_ssize_t size = d->size;
    const double *a = d->a, *b = d->b, *det = d->det;
    double *aa = bends->aa, *ab = bends->ab, *bb = bends->bb;
    double c = mixture[MIPS];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double D = positive(det[j]), scale = c * 8 / (D * D * D);
            aa[j] += scale * b[j];
            ab[j] -= 0.5 * scale * (a[j] + b[j]);
            bb[j] += scale * a[j];
        }
    c = mixture[SYMMETRIC_DIRICHLET];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double inverse = 1 / positive(det[j]), cube = inverse * inverse * inverse;
            const double cubic = c * 4 * cube, shear = c * 24 * b[j] * (cube * inverse);
            aa[j] += cubic + shear;
            ab[j] -= 3 * cubic + shear;
            bb[j] += 5 * cubic + shear;
        }
    c = mixture[ARAP];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double root = sqrt(a[j]), inverse = 1 / (root > 0 ? root : 1);
            aa[j] += c * (root > 0 ? inverse * inverse * inverse : 0);
        }
    c = mixture[AREA_BARRIER];
    if (c != 0)
        for (Py_ssize_t j = 0; j < size; j++) {
            const double D = positive(det[j]), bend = c * 2 / (D * D * D);
            aa[j] += bend;
            ab[j] -= bend;
            bb[j] += bend;
        }
}

/* The first derivatives, and the second ones unless `bends` is NULL. */
static void take_derivatives(const double *mixture, const Squares *d, Slopes *slopes, Bends *bends)
{
    const double k = mixture[CUBE], linear_from = mixture[LINEAR_FROM];
    memset(slopes, 0, sizeof *slopes);
    add_slopes(mixture, d, slopes);
    if (bends) {
        memset(bends, 0, sizeof *bends);
        add_bends(mixture, d, bends);
    }
    if (k == 0)
        return;
    double density[CHUNK] = {0};
    add_densities(mixture, d, density);
    for (Py_ssize_t j = 0; j < d->size; j++) {
        const double e = density[j], least = e > linear_from ? linear_from : e;
        const double factor = 1 + 3 * k * (least * least), square = e > linear_from ? 0 : 6 * k * e;
        /* Squares of large slopes can overflow, and are not needed where the energy is linear in E. */
        const double by_a = e > linear_from ? 0 : slopes->a[j], by_b = e > linear_from ? 0 : slopes->b[j];
        slopes->a[j] *= factor;
        slopes->b[j] *= factor;
        if (bends) {
            bends->aa[j] = factor * bends->aa[j] + square * (by_a * by_a);
            bends->ab[j] = factor * bends->ab[j] + square * (by_a * by_b);
            bends->bb[j] = factor * bends->bb[j] + square * (by_b * by_b);
        }
    }
}

/* (mixture, p, q, det, share): the sum over triangles. */
static PyObject *mixed_energy(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument arguments[5];
    if (!take("mixed_energy", given, count, "dzzdd", arguments))
        return NULL;
    const double *mixture = arguments[0].data, *share = arguments[4].data;
    const Py_ssize_t f = arguments[3].size;
    if (!fit("mixed_energy", arguments, LENGTH(arguments),
             arguments[0].size == NUMBERS && arguments[1].size == f && arguments[2].size == f &&
             arguments[4].size == f))
        return NULL;
    double total = 0, lost = 0, plain = 0;
    Squares d;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        take_squares(arguments[1].data, arguments[2].data, arguments[3].data, start, f, &d);
        double density[CHUNK], part[4] = {0};
        take_densities(mixture, &d, density);
        for (Py_ssize_t j = 0; j < d.size; j++)
            density[j] *= share[start + j];
        for (Py_ssize_t j = 0; j < CHUNK; j += 4)
            for (int k = 0; k < 4; k++)
                part[k] += density[j + k];
        /* What rounding loses of the sum of the sums is kept: steps are judged by the last digits of the energy. */
        const double sum = (part[0] + part[1]) + (part[2] + part[3]), more = sum - lost, next = total + more;
        plain += sum;
        lost = (next - total) - more;
        total = next;
    }
    Py_END_ALLOW_THREADS
    /* Of what is infinite nothing is lost. */
    return done_with_number(arguments, LENGTH(arguments), isfinite(plain) ? total : plain);
}

/* (mixture, p, q, det, by_p, by_q). */
static PyObject *mixed_slopes(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument arguments[6];
    if (!take("mixed_slopes", given, count, "dzzdZZ", arguments))
        return NULL;
    const double *p = arguments[1].data, *q = arguments[2].data;
    double *by_p = arguments[4].data, *by_q = arguments[5].data;
    const Py_ssize_t f = arguments[3].size;
    if (!fit("mixed_slopes", arguments, LENGTH(arguments),
             arguments[0].size == NUMBERS && arguments[1].size == f && arguments[2].size == f &&
             arguments[4].size == f && arguments[5].size == f))
        return NULL;
    Squares d;
    Slopes slopes;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        take_squares(p, q, arguments[3].data, start, f, &d);
        take_derivatives(arguments[0].data, &d, &slopes, NULL);
        for (Py_ssize_t j = 0; j < d.size; j++) {
            const Py_ssize_t x = 2 * (start + j), y = x + 1;
            const double to_p = 2 * slopes.a[j], to_q = 2 * slopes.b[j];
            by_p[x] = to_p * p[x];
            by_p[y] = to_p * p[y];
            by_q[x] = to_q * q[x];
            by_q[y] = to_q * q[y];
        }
    }
    Py_END_ALLOW_THREADS
    return done(arguments, LENGTH(arguments));
}

/* Negative eigenvalues multiplied. */
static double damped(double eigenvalue, double negative)
{
    return eigenvalue < 0 ? negative * eigenvalue : eigenvalue;
}

/* 1/x, and 0 at 0; not by a jump. */
static double inverse(double x)
{
    const double divided = 1 / (x > 0 ? x : 1);
    return x > 0 ? divided : 0;
}

/* Of the forms of a chunk: what |dp|^2 and |dq|^2 are multiplied by, and what dp^2, dq^2 and both products of dp and dq
   are multiplied by besides p and q. */
typedef struct {
    double pp[CHUNK], qq[CHUNK], p2[CHUNK], q2[CHUNK], mixed[CHUNK];
} Filtered;

static void filter(const Squares *d, const Slopes *slopes, const Bends *bends, const double *share, double negative,
                   Filtered *to)
{
    for (Py_ssize_t j = 0; j < d->size; j++) {
        const double a = d->a[j], b = d->b[j], ab = 4 * bends->ab[j], c = share[j];
        const double turn_p = 2 * slopes->a[j], turn_q = 2 * slopes->b[j];
        const double xx = turn_p + 4 * a * bends->aa[j], xy = sqrt(a * b) * ab, yy = turn_q + 4 * b * bends->bb[j];
        /* The eigenvalues of [xx, xy; xy, yy] are mean + radius and mean - radius. */
        const double mean = 0.5 * (xx + yy), half = 0.5 * (xx - yy), radius = sqrt(half * half + xy * xy);
        const double upper = damped(mean + radius, negative), lower = damped(mean - radius, negative);
        const double centre = 0.5 * (upper + lower), kept = 0.5 * (upper - lower) * inverse(radius);
        const double along_p = centre + kept * half, along_q = centre - kept * half;
        const double across_p = damped(turn_p, negative), across_q = damped(turn_q, negative);
        to->pp[j] = c * (0.5 * (along_p + across_p));
        to->qq[j] = c * (0.5 * (along_q + across_q));
        to->p2[j] = c * (0.5 * (along_p - across_p) * inverse(a));
        to->q2[j] = c * (0.5 * (along_q - across_q) * inverse(b));
        to->mixed[j] = c * (kept * ab);
    }
}

/* (mixture, p, q, det, share, negative, pp, qq, p2, q2, pq, pqc). */
static PyObject *mixed_curvature(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument arguments[12];
    if (!take("mixed_curvature", given, count, "dzzddxDDZZZZ", arguments))
        return NULL;
    const double *mixture = arguments[0].data, *p = arguments[1].data, *q = arguments[2].data;
    const double *share = arguments[4].data;
    double *pp = arguments[6].data, *qq = arguments[7].data, *p2 = arguments[8].data, *q2 = arguments[9].data;
    double *pq = arguments[10].data, *pqc = arguments[11].data;
    const Py_ssize_t f = arguments[3].size;
    if (!fit("mixed_curvature", arguments, LENGTH(arguments),
             arguments[0].size == NUMBERS && arguments[1].size == f && arguments[2].size == f &&
             arguments[4].size == f && arguments[6].size == f && arguments[7].size == f &&
             arguments[8].size == f && arguments[9].size == f && arguments[10].size == f &&
             arguments[11].size == f))
        return NULL;
    Squares d;
    Slopes slopes;
    Bends bends;
    Filtered kept;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        take_squares(p, q, arguments[3].data, start, f, &d);
        take_derivatives(mixture, &d, &slopes, &bends);
        filter(&d, &slopes, &bends, share + start, arguments[5].number, &kept);
        for (Py_ssize_t j = 0; j < d.size; j++) {
            const Py_ssize_t x = 2 * (start + j), y = x + 1;
            const double px = p[x], py = p[y], qx = q[x], qy = q[y], mixed = kept.mixed[j];
            pp[start + j] = kept.pp[j];
            qq[start + j] = kept.qq[j];
            p2[x] = kept.p2[j] * (px * px - py * py);
            p2[y] = kept.p2[j] * (-2 * px * py);
            q2[x] = kept.q2[j] * (qx * qx - qy * qy);
            q2[y] = kept.q2[j] * (-2 * qx * qy);
            pq[x] = mixed * (px * qx - py * qy);
            pq[y] = -mixed * (px * qy + py * qx);
            pqc[x] = mixed * (px * qx + py * qy);
            pqc[y] = mixed * (px * qy - py * qx);
        }
    }
    Py_END_ALLOW_THREADS
    return done(arguments, LENGTH(arguments));
}

PyMethodDef mixtures_kernels[] = {KERNEL(mixed_energy), KERNEL(mixed_slopes), KERNEL(mixed_curvature), END_OF_KERNELS};
