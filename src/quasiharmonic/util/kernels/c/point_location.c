/* Kernels of `geometry/exact/point_location.py`. */
#include "arguments.h"

enum { NOWHERE = -1 };

/* The least of the determinants of a point with the edges of a triangle. */
static double least_determinant(const double *point, const double *row)
{
    const double ax = row[0] - point[0], ay = row[1] - point[1], bx = row[2] - point[0], by = row[3] - point[1];
    const double cx = row[4] - point[0], cy = row[5] - point[1];
    const double ab = ax * by - ay * bx, bc = bx * cy - by * cx, ca = cx * ay - cy * ax;
    const double least = ab < bc ? ab : bc;
    return least < ca ? least : ca;
}

/* (points, begin, end, listed, rows, hits): the first of each point's triangles that is not surely outside, if it surely
   contains the point. */
static PyObject *sure_hits(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("sure_hits", given, count, "dqqidQ", a))
        return NULL;
    const double *points = a[0].data, *rows = a[4].data;
    const int64_t *begin = a[1].data, *end = a[2].data;
    const int32_t *listed = a[3].data;
    int64_t *hits = a[5].data;
    if (!fit("sure_hits", a, LENGTH(a),
             a[0].size == 2 * a[5].size && a[1].size == a[5].size && a[2].size == a[5].size && a[4].size % 6 == 0))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < a[5].size; i++) {
        hits[i] = NOWHERE;
        for (int64_t k = begin[i]; k < end[i]; k++) {
            const double least = least_determinant(points + 2 * i, rows + 6 * (Py_ssize_t)listed[k]);
            if (least >= -UNSURE) {
                hits[i] = least > UNSURE ? listed[k] : UNDECIDED;
                break;
            }
        }
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef point_location_kernels[] = {KERNEL(sure_hits), END_OF_KERNELS};
