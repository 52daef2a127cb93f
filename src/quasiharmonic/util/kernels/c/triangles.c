/* Kernels of `geometry/exact/triangles.py`. */
#include "arguments.h"
#include "predicates.h"

/* (F, uv, sign): orientations of triangles, 0 where floating point is not sure; how many of these there are, or -1 where
 * F names a vertex that there is not. */
static PyObject *sure_signs(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("sure_signs", given, count, "qdB", a))
        return NULL;
    const int64_t *F = a[0].data;
    const double *uv = a[1].data;
    const Py_ssize_t f = a[2].size, n = a[1].size / 2;
    int8_t *sign = a[2].data;
    if (!fit("sure_signs", a, LENGTH(a),
             a[0].size == 3 * f))
        return NULL;
    Py_ssize_t open = 0;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < f; j++) {
        const int64_t *corner = F + 3 * j;
        if (corner[0] < 0 || corner[0] >= n || corner[1] < 0 || corner[1] >= n || corner[2] < 0 || corner[2] >= n) {
            open = -1;
            break;
        }
        sign[j] = (int8_t)sure_orientation(uv + 2 * corner[0], uv + 2 * corner[1], uv + 2 * corner[2]);
        open += !sign[j];
    }
    Py_END_ALLOW_THREADS
    return done_with_integer(a, LENGTH(a), open);
}

/* (F, uv, turns): how often triangles wind around their vertices, added up. */
static PyObject *count_turns(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("count_turns", given, count, "qdQ", a))
        return NULL;
    const int64_t *F = a[0].data;
    const double *uv = a[1].data;
    int64_t *turns = a[2].data;
    if (!fit("count_turns", a, LENGTH(a),
             a[0].size % 3 == 0 && a[1].size == 2 * a[2].size))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < a[0].size; j += 3) {
        const double level[] = {uv[2 * F[j] + 1], uv[2 * F[j + 1] + 1], uv[2 * F[j + 2] + 1]};
        for (int corner = 0; corner < 3; corner++)
            turns[F[j + corner]] += level[(corner + 1) % 3] < level[corner] && level[(corner + 2) % 3] >= level[corner];
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef triangles_kernels[] = {KERNEL(sure_signs), KERNEL(count_turns), END_OF_KERNELS};
