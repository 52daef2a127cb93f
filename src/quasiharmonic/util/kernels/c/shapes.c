/* Kernel of `apps/atlas/packing/shapes.py`. */
#include "arguments.h"

#include <math.h>

/* Add a point to a chain of corners of which the first `kept` stay; their number. */
static int64_t add_corner(const double *z, int64_t i, int64_t kept, int64_t *corners, int64_t count)
{
    for (; count > kept; count--) {
        const double *a = z + 2 * corners[count - 2], *b = z + 2 * corners[count - 1];
        const double along = z[2 * i] - a[0], up = z[2 * i + 1] - a[1], across = b[0] - a[0], high = b[1] - a[1];
        const double turn = up * across - along * high;
        const int beyond = along * across + up * high > along * along + up * up;
        if (turn > (beyond ? 0 : LEAST_HEIGHT * (fabs(along) + fabs(up))))
            break;
    }
    corners[count] = i;
    return count + 1;
}

/* (points, corners): the corners of the convex hull of points of whole numbers, sorted; their number. */
static PyObject *find_hull(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[2];
    if (!take("find_hull", given, count, "zQ", a))
        return NULL;
    const Py_ssize_t size = a[0].size;
    if (!fit("find_hull", a, LENGTH(a), a[1].size == size + 1))
        return NULL;
    const double *z = a[0].data;
    int64_t *corners = a[1].data, found = 0;
    for (int64_t i = 0; i < size; i++)
        found = add_corner(z, i, 1, corners, found);
    const int64_t kept = found;
    for (int64_t i = size - 2; i >= 0; i--)
        found = add_corner(z, i, kept, corners, found);
    return done_with_integer(a, LENGTH(a), found > 1 ? found - 1 : 1);
}

PyMethodDef shapes_kernels[] = {KERNEL(find_hull), END_OF_KERNELS};
