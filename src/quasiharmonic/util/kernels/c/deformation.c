/* Kernels of `energies/deformation.py`: Jacobians of a map, forces on its vertices, the step at which triangles collapse. */
#include "arguments.h"

#include <math.h>
#include <string.h>

/* Triangles at a time: what is read of the corners is laid out in the core's first cache, for loops without jumps. */
enum { CHUNK = 128 };

/* The edges from corner 0 of the images of triangles. */
typedef struct {
    double x1[CHUNK], y1[CHUNK], x2[CHUNK], y2[CHUNK];
} Edges;

static void take_edges(const double *w, const int64_t *F, Py_ssize_t count, Edges *edges)
{
    for (Py_ssize_t j = 0; j < count; j++) {
        const double *w0 = w + 2 * F[3 * j], *w1 = w + 2 * F[3 * j + 1], *w2 = w + 2 * F[3 * j + 2];
        edges->x1[j] = w1[0] - w0[0];
        edges->y1[j] = w1[1] - w0[1];
        edges->x2[j] = w2[0] - w0[0];
        edges->y2[j] = w2[1] - w0[1];
    }
}

static Py_ssize_t chunk(Py_ssize_t start, Py_ssize_t count)
{
    return count - start < CHUNK ? count - start : CHUNK;
}

/* (w, F, g, det_per_area, p, q, det). */
static PyObject *jacobians(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[7];
    if (!take("jacobians", given, count, "zqzdZZD", a))
        return NULL;
    const double *w = a[0].data, *det_per_area = a[3].data;
    const int64_t *F = a[1].data;
    double *p = a[4].data, *q = a[5].data, *det = a[6].data;
    const Py_ssize_t f = a[6].size;
    if (!fit("jacobians", a, LENGTH(a),
             a[1].size == 3 * f && a[2].size == 3 * f && a[3].size == f && a[4].size == f && a[5].size == f))
        return NULL;
    const double *gradients = a[2].data;
    Edges edges;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        const Py_ssize_t size = chunk(start, f);
        take_edges(w, F + 3 * start, size, &edges);
        const double *g1 = gradients + 2 * (f + start), *g2 = g1 + 2 * f;
        for (Py_ssize_t j = 0; j < size; j++) {
            const double x1 = edges.x1[j], y1 = edges.y1[j], x2 = edges.x2[j], y2 = edges.y2[j];
            const double s1 = g1[2 * j], t1 = g1[2 * j + 1], s2 = g2[2 * j], t2 = g2[2 * j + 1];
            double *to_p = p + 2 * (start + j), *to_q = q + 2 * (start + j);
            to_p[0] = (x1 * s1 + y1 * t1) + (x2 * s2 + y2 * t2);
            to_p[1] = (y1 * s1 - x1 * t1) + (y2 * s2 - x2 * t2);
            to_q[0] = (x1 * s1 - y1 * t1) + (x2 * s2 - y2 * t2);
            to_q[1] = (x1 * t1 + y1 * s1) + (x2 * t2 + y2 * s2);
        }
        for (Py_ssize_t j = 0; j < size; j++) {
            const double left = edges.x1[j] * edges.y2[j], right = edges.y1[j] * edges.x2[j];
            const double area = left - right, noise = 0x1p-51 * (fabs(left) + fabs(right));
            det[start + j] = 0.5 * (fabs(area) <= noise ? noise : area) * det_per_area[start + j];
        }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* (by_p, by_q, share, F, g, gradient). */
static PyObject *pulls(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("pulls", given, count, "zzdqzZ", a))
        return NULL;
    const double *by_p = a[0].data, *by_q = a[1].data, *share = a[2].data, *g = a[4].data;
    const int64_t *F = a[3].data;
    double *gradient = a[5].data;
    const Py_ssize_t f = a[2].size;
    if (!fit("pulls", a, LENGTH(a),
             a[0].size == f && a[1].size == f && a[3].size == 3 * f && a[4].size == 3 * f))
        return NULL;
    double pull[3][2 * CHUNK];
    Py_BEGIN_ALLOW_THREADS
    memset(gradient, 0, 2 * sizeof(double) * (size_t)a[5].size);
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        const Py_ssize_t size = chunk(start, f);
        for (Py_ssize_t j = 0; j < size; j++) {
            const double *along_p = by_p + 2 * (start + j), *along_q = by_q + 2 * (start + j), c = share[start + j];
            const double px = c * along_p[0], py = c * along_p[1], qx = c * along_q[0], qy = c * along_q[1];
            for (int corner = 0; corner < 3; corner++) {
                const double *here = g + 2 * (corner * f + start + j);
                pull[corner][2 * j] = (px + qx) * here[0] + (qy - py) * here[1];
                pull[corner][2 * j + 1] = (py + qy) * here[0] + (px - qx) * here[1];
            }
        }
        for (Py_ssize_t j = 0; j < size; j++)
            for (int corner = 0; corner < 3; corner++) {
                double *to = gradient + 2 * F[3 * (start + j) + corner];
                to[0] += pull[corner][2 * j];
                to[1] += pull[corner][2 * j + 1];
            }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* (w, direction, F, first). */
static PyObject *collapses(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[4];
    if (!take("collapses", given, count, "zzqD", a))
        return NULL;
    const int64_t *F = a[2].data;
    double *first = a[3].data;
    const Py_ssize_t f = a[3].size;
    if (!fit("collapses", a, LENGTH(a),
             a[0].size == a[1].size && a[2].size == 3 * f))
        return NULL;
    Edges here, by;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t start = 0; start < f; start += CHUNK) {
        const Py_ssize_t size = chunk(start, f);
        take_edges(a[0].data, F + 3 * start, size, &here);
        take_edges(a[1].data, F + 3 * start, size, &by);
        for (Py_ssize_t j = 0; j < size; j++) {
            const double c0 = here.x1[j] * here.y2[j] - here.y1[j] * here.x2[j];
            const double c1 =
                here.x1[j] * by.y2[j] - here.y1[j] * by.x2[j] + by.x1[j] * here.y2[j] - by.y1[j] * here.x2[j];
            const double c2 = by.x1[j] * by.y2[j] - by.y1[j] * by.x2[j];
            const double square = c1 * c1, limit = 4 * c0 * c2, rest = square - limit;
            const double root = sqrt(rest > 0 ? rest : 0);
            /* Both ways are taken and one result is chosen: that is quicker than a jump. */
            const int falls = c1 < 0;
            const double above = falls ? 2 * c0 : c1 + root, below = falls ? root - c1 : -2 * c2;
            const int zero = (c0 > 0) & (square >= limit) & (falls | (c2 < 0));
            first[start + j] = (zero ? above : INFINITY) / (zero ? below : 1);
        }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef deformation_kernels[] = {KERNEL(jacobians), KERNEL(pulls), KERNEL(collapses), END_OF_KERNELS};
