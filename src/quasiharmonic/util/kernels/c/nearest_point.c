/* Kernels of `geometry/mesh/point_queries.py`. */
#include "arguments.h"

#include <math.h>

static double dot(const double *x, const double *y)
{
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
}

static void subtract(const double *x, const double *y, double *difference)
{
    for (int i = 0; i < 3; i++)
        difference[i] = x[i] - y[i];
}

/* The weights of the point of a triangle's sides that is nearest to a point. */
static void nearest_on_sides(const double *point, const double *corners, double *weights)
{
    double best = INFINITY;
    for (int i = 0; i < 3; i++) {
        const double *tail = corners + 3 * i, *head = corners + 3 * ((i + 1) % 3);
        double side[3], from[3], apart[3];
        subtract(head, tail, side);
        subtract(point, tail, from);
        const double length = dot(side, side);
        double share = length > 0 ? dot(from, side) / length : 0;
        share = share < 0 ? 0 : share > 1 ? 1 : share;
        for (int k = 0; k < 3; k++)
            apart[k] = tail[k] + share * side[k] - point[k];
        const double distance = dot(apart, apart);
        if (distance < best) {
            best = distance;
            weights[(i + 2) % 3] = 0;
            weights[i] = 1 - share;
            weights[(i + 1) % 3] = share;
        }
    }
}

/* The weights of the nearest point of a triangle to a point; its squared distance. */
static double nearest_in_triangle(const double *point, const double *corners, double *weights)
{
    double u[3], v[3], w[3], apart[3];
    subtract(corners + 3, corners, u);
    subtract(corners + 6, corners, v);
    subtract(point, corners, w);
    const double uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w);
    const double area = uu * vv - uv * uv;
    const double second = (vv * uw - uv * vw) / area, third = (uu * vw - uv * uw) / area;
    weights[0] = 1 - second - third;
    weights[1] = second;
    weights[2] = third;
    if (!(area > 0 && second >= 0 && third >= 0 && second + third <= 1)) {
        weights[0] = weights[1] = weights[2] = 0;
        nearest_on_sides(point, corners, weights);
    }
    for (int k = 0; k < 3; k++)
        apart[k] = weights[0] * corners[k] + weights[1] * corners[3 + k] + weights[2] * corners[6 + k] - point[k];
    return dot(apart, apart);
}

/* (points, corners, candidate, reach, triangle, weights, squared): candidates that are nearer replace the nearest ones. */
static PyObject *improve_nearest(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[7];
    if (!take("improve_nearest", given, count, "ddqdQDD", a))
        return NULL;
    const double *points = a[0].data, *corners = a[1].data, *reach = a[3].data;
    const int64_t *candidate = a[2].data;
    int64_t *triangle = a[4].data;
    double *weights = a[5].data, *squared = a[6].data;
    const Py_ssize_t n = a[6].size, many = n ? a[2].size / n : 0;
    if (!fit("improve_nearest", a, LENGTH(a),
             a[0].size == 3 * n && a[1].size % 9 == 0 && a[2].size == n * many && a[3].size == a[2].size &&
                 a[4].size == n && a[5].size == 3 * n && are_indices(a + 2, a[1].size / 9)))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < n; i++)
        for (Py_ssize_t j = i * many; j < (i + 1) * many; j++) {
            if (!(reach[j] < sqrt(squared[i])) || candidate[j] == triangle[i])
                continue;
            double found[3];
            const double distance = nearest_in_triangle(points + 3 * i, corners + 9 * candidate[j], found);
            if (distance < squared[i]) {
                triangle[i] = candidate[j];
                squared[i] = distance;
                for (int k = 0; k < 3; k++)
                    weights[3 * i + k] = found[k];
            }
        }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef nearest_point_kernels[] = {KERNEL(improve_nearest), END_OF_KERNELS};
