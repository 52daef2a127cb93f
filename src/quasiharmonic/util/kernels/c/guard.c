/* Kernels of `linsolve/base.py`: norms of a matrix and residuals of a solution. */
#include "arguments.h"

#include <math.h>

/* (indptr, indices, values, signs, root, probe, image): S^-1, z = S signs and A z; -1, or the first row whose diagonal
   entry is not positive. */
static PyObject *probe_matrix(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[7];
    if (!take("probe_matrix", given, count, "iiddDDD", a))
        return NULL;
    const int32_t *indptr = a[0].data, *indices = a[1].data;
    const double *values = a[2].data, *signs = a[3].data;
    double *root = a[4].data, *probe = a[5].data, *image = a[6].data;
    const Py_ssize_t n = a[3].size;
    if (!fit("probe_matrix", a, LENGTH(a),
             a[0].size == n + 1 && a[1].size == indptr[n] && a[2].size == indptr[n] && a[4].size == n &&
             a[5].size == n && a[6].size == n))
        return NULL;
    Py_ssize_t worst = -1;
    for (Py_ssize_t i = 0; i < n && worst < 0; i++)
        if (!(values[indptr[i]] > 0))
            worst = i;
    if (worst >= 0)
        return done_with_integer(a, LENGTH(a), worst);
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < n; i++) {
        const double diagonal = values[indptr[i]];
        root[i] = sqrt(diagonal);
        probe[i] = signs[i] / root[i];
        image[i] = diagonal * probe[i];
    }
    for (Py_ssize_t i = 0; i < n; i++) {
        double sum = 0.0;
        for (int32_t k = indptr[i] + 1; k < indptr[i + 1]; k++) {
            sum += values[k] * probe[indices[k]];
            image[indices[k]] += values[k] * probe[i];
        }
        image[i] += sum;
    }
    Py_END_ALLOW_THREADS
    return done_with_integer(a, LENGTH(a), -1);
}

/* (root, probe, image, b, x, sizes): |z'b - (A z)'x| and the sizes of S b and S^-1 x, of each row of b and x. */
static PyObject *scaled_sizes(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("scaled_sizes", given, count, "dddddD", a))
        return NULL;
    const double *root = a[0].data, *probe = a[1].data, *image = a[2].data;
    double *sizes = a[5].data;
    const Py_ssize_t n = a[0].size, rows = a[5].columns;
    if (!fit("scaled_sizes", a, LENGTH(a),
             a[1].size == n && a[2].size == n && a[3].size == rows * n && a[4].size == rows * n && a[5].rows == 3))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < rows; j++) {
        const double *b = (const double *)a[3].data + j * n, *x = (const double *)a[4].data + j * n;
        double along_x = 0.0, along_b = 0.0, size_b = 0.0, size_x = 0.0;
        for (Py_ssize_t i = 0; i < n; i++) {
            const double scaled_b = probe[i] * b[i], scaled_x = root[i] * x[i];
            along_x += image[i] * x[i];
            along_b += scaled_b;
            size_b += scaled_b * scaled_b;
            size_x += scaled_x * scaled_x;
        }
        sizes[j] = fabs(along_x - along_b);
        sizes[rows + j] = sqrt(size_b);
        sizes[2 * rows + j] = sqrt(size_x);
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef guard_kernels[] = {KERNEL(probe_matrix), KERNEL(scaled_sizes), END_OF_KERNELS};
