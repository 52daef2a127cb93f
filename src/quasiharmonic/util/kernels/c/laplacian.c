/* Kernels of `linsolve/laplacian.py`: the matrix and the right-hand side of a stiffness, and the map of a solution. */
#include "arguments.h"

/* (stiffness, indptr, row, column, halves, offsets, border, border_row, values): values of the upper triangle. */
static PyObject *assemble(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[9];
    if (!take("assemble", given, count, "diqqiiqqD", a))
        return NULL;
    const double *stiffness = a[0].data;
    const int32_t *diagonal = a[1].data, *halves = a[4].data, *offsets = a[5].data;
    const int64_t *row = a[2].data, *column = a[3].data, *border = a[6].data, *border_row = a[7].data;
    double *values = a[8].data;
    if (!fit("assemble", a, LENGTH(a),
             a[1].size > 0 && a[3].size == a[2].size && a[5].size == a[2].size + 1 &&
             a[4].size == offsets[a[2].size] && a[7].size == a[6].size && a[8].size == a[1].size - 1 + a[2].size))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < a[1].size - 1; i++)
        values[diagonal[i]] = 0.0;
    /* Rows sum to zero, so each half-edge is taken off the diagonal at both of its ends. */
    for (Py_ssize_t k = 0; k < a[2].size; k++) {
        double above = 0.0;
        for (int32_t h = offsets[k]; h < offsets[k + 1]; h++)
            above += stiffness[halves[h]];
        values[diagonal[row[k]]] -= above;
        values[diagonal[column[k]]] -= above;
        values[k + row[k] + 1] = above;
    }
    for (Py_ssize_t k = 0; k < a[6].size; k++)
        values[diagonal[border_row[k]]] -= stiffness[border[k]];
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* (stiffness, border, border_row, border_fixed, w, load): both coordinates of the right-hand side, (2, n). */
static PyObject *boundary_load(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("boundary_load", given, count, "dqqqzD", a))
        return NULL;
    const double *stiffness = a[0].data, *w = a[4].data;
    const int64_t *border = a[1].data, *border_row = a[2].data, *border_fixed = a[3].data;
    double *u = a[5].data, *v = u + a[5].columns;
    if (!fit("boundary_load", a, LENGTH(a),
             a[2].size == a[1].size && a[3].size == a[1].size && a[5].rows == 2 && are_indices(a + 1, a[0].size) &&
             are_indices(a + 2, a[5].columns) && are_indices(a + 3, a[4].size)))
        return NULL;
    for (Py_ssize_t i = 0; i < a[5].size; i++)
        u[i] = 0.0;
    for (Py_ssize_t k = 0; k < a[1].size; k++) {
        const double pull = stiffness[border[k]], *at = w + 2 * border_fixed[k];
        u[border_row[k]] -= pull * at[0];
        v[border_row[k]] -= pull * at[1];
    }
    return done(a, LENGTH(a));
}

/* (solution, free, out): coordinates (2, k) into their places in a map. */
static PyObject *put_at(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("put_at", given, count, "dqZ", a))
        return NULL;
    const double *u = a[0].data, *v = u + a[0].columns;
    const int64_t *free = a[1].data;
    double *out = a[2].data;
    if (!fit("put_at", a, LENGTH(a),
             a[0].rows == 2 && a[0].columns == a[1].size))
        return NULL;
    for (Py_ssize_t i = 0; i < a[1].size; i++) {
        out[2 * free[i]] = u[i];
        out[2 * free[i] + 1] = v[i];
    }
    return done(a, LENGTH(a));
}

PyMethodDef laplacian_kernels[] = {KERNEL(assemble), KERNEL(boundary_load), KERNEL(put_at), END_OF_KERNELS};
