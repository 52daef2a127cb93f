/* Kernels of `solver/methods/vector_adam.py`. */
#include "arguments.h"

#include <math.h>

/* (gradient, first, second, length, mean, square, step): a gradient into its means, and the step that follows. */
static PyObject *adam_step(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[7];
    if (!take("adam_step", given, count, "zxxxZDZ", a))
        return NULL;
    const double *gradient = a[0].data, first = a[1].number, second = a[2].number, length = a[3].number;
    double *mean = a[4].data, *square = a[5].data, *step = a[6].data;
    if (!fit("adam_step", a, LENGTH(a),
             a[4].size == a[0].size && a[5].size == a[0].size && a[6].size == a[0].size))
        return NULL;
    for (Py_ssize_t j = 0; j < a[0].size; j++) {
        const double x = gradient[2 * j], y = gradient[2 * j + 1];
        mean[2 * j] = first * mean[2 * j] + (1 - first) * x;
        mean[2 * j + 1] = first * mean[2 * j + 1] + (1 - first) * y;
        square[j] = second * square[j] + (1 - second) * (x * x + y * y);
        /* A triangle whose gradient has never differed from zero stays where it is. */
        const double by = square[j] == 0 ? -0.0 : -length / sqrt(square[j]);
        step[2 * j] = by * mean[2 * j];
        step[2 * j + 1] = by * mean[2 * j + 1];
    }
    return done(a, LENGTH(a));
}

PyMethodDef vector_adam_kernels[] = {KERNEL(adam_step), END_OF_KERNELS};
