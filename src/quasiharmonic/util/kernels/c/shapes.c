/* Kernel of `apps/atlas/packing/shapes.py`. */
#include "arguments.h"

#include <math.h>

/* Add a point to a chain of corners of which the first `least` stay; their number. */
static int64_t add_corner(const double *z, double close, int64_t i, int64_t least, int64_t *corners, int64_t count)
{
    while (count > least) {
        const double *a = z + 2 * corners[count - 2], *b = z + 2 * corners[count - 1];
        const double along = z[2 * i] - a[0], up = z[2 * i + 1] - a[1];
        if (along * (b[1] - a[1]) - up * (b[0] - a[0]) < -close * (fabs(along) + fabs(up)))
            break;
        count--;
    }
    corners[count] = i;
    return count + 1;
}

/* (points, close, corners): the corners of a convex hull; their number. */
static PyObject *find_hull(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("find_hull", given, count, "zxQ", a))
        return NULL;
    const Py_ssize_t size = a[0].size;
    if (!fit("find_hull", a, LENGTH(a), a[2].size == size + 1))
        return NULL;
    const double *z = a[0].data;
    int64_t *corners = a[2].data, found = 0;
    for (int64_t i = 0; i < size; i++)
        found = add_corner(z, a[1].number, i, 1, corners, found);
    const int64_t least = found;
    for (int64_t i = size - 2; i >= 0; i--)
        found = add_corner(z, a[1].number, i, least, corners, found);
    return done_with_integer(a, LENGTH(a), found > 1 ? found - 1 : 1);
}

PyMethodDef shapes_kernels[] = {KERNEL(find_hull), END_OF_KERNELS};
