/* Kernels of `geometry/prolongation.py`.
 *
 * The best position is chosen by comparison. All operations have the order of the NumPy version, so that both versions
 * choose the same position.
 */
#include "arguments.h"

#include <math.h>
#include <stdlib.h>

typedef struct {
    double x, y;
} Point;

/* Places to try, and where none of these will do: so far from the apex towards the middle, and so far straight in. */
static const double middle_fractions[2][2] = TOWARDS_MIDDLE;
static const double inward_distances[2][3] = INWARDS;

static Point middle(const Point *ring, Py_ssize_t d)
{
    Point sum = ring[0];
    for (Py_ssize_t i = 1; i < d; i++) {
        sum.x += ring[i].x;
        sum.y += ring[i].y;
    }
    return (Point){sum.x / (double)d, sum.y / (double)d};
}

/* Squared sides over twice the area, summed over the triangles around a place; infinite if one is inverted. */
static double shape(Point place, const Point *ring, Py_ssize_t d)
{
    Point a = {ring[d - 1].x - place.x, ring[d - 1].y - place.y};
    double square = a.x * a.x + a.y * a.y, sum = 0;
    for (Py_ssize_t i = 0; i < d; i++) {
        const Point b = {ring[i].x - place.x, ring[i].y - place.y};
        const double next = b.x * b.x + b.y * b.y, area = a.x * b.y - a.y * b.x;
        if (!(area > 0))
            return INFINITY;
        sum += (square + next - a.x * b.x - a.y * b.y) / area;
        a = b;
        square = next;
    }
    return 2 * sum;
}

static double length(Point arm)
{
    return sqrt(arm.x * arm.x + arm.y * arm.y);
}

static Point difference(Point one, Point other)
{
    return (Point){one.x - other.x, one.y - other.y};
}

static Point times(Point one, Point other)
{
    return (Point){one.x * other.x - one.y * other.y, one.x * other.y + one.y * other.x};
}

/* From the apex straight into a ring, as far as the nearest side is away: half the turn from the first arm to the last. */
static Point inwards(const Point *ring, Py_ssize_t d)
{
    const Point first = difference(ring[1], ring[0]);
    const double reach = length(first);
    Point right = first, turn = {1, 0};
    double here = reach, room = INFINITY;
    for (Py_ssize_t i = 2; i < d; i++) {
        const Point left = difference(ring[i], ring[0]);
        const double next = length(left), size = next * here;
        const double cosine = right.x * left.x + right.y * left.y, sine = right.x * left.y - right.y * left.x;
        const double distance = sine / length(difference(left, right));
        /* What is no number stays, as in NumPy's minimum. */
        if (distance < room || isnan(distance))
            room = distance;
        Point half = {cosine / size + 1, sine / size};
        const double unit = length(half);
        half.x /= unit;
        half.y /= unit;
        turn = times(turn, half);
        right = left;
        here = next;
    }
    const double share = room / reach;
    return times((Point){share * first.x, share * first.y}, turn);
}

/* Where to put a vertex into a ring, the apex first. */
static Point best_place(const Point *ring, Py_ssize_t d)
{
    const Point centre = middle(ring, d), apex = ring[0];
    Point best = centre;
    double lowest = shape(centre, ring, d);
    if (lowest < GOOD * (double)d)
        return best;
    const Point arms[] = {difference(centre, apex), inwards(ring, d)};
    for (int likely = 0; likely < 2 && (!likely || isinf(lowest)); likely++)
        for (int k = 0; k < 5; k++) {
            const double reach = k < 2 ? middle_fractions[likely][k] : inward_distances[likely][k - 2];
            const Point *arm = &arms[k >= 2], place = {apex.x + reach * arm->x, apex.y + reach * arm->y};
            const double here = shape(place, ring, d);
            if (here < lowest) {
                lowest = here;
                best = place;
            }
        }
    return best;
}

/* (ring, place): where to put a vertex into each ring. */
static PyObject *find_places(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[2];
    if (!take("find_places", given, count, "zZ", a))
        return NULL;
    const Point *ring = a[0].data;
    Point *place = a[1].data;
    const Py_ssize_t d = a[0].columns;
    if (!fit("find_places", a, LENGTH(a),
             d >= 3 && a[0].size == d * a[1].size))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < a[1].size; i++)
        place[i] = best_place(ring + i * d, d);
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

/* A vertex on its way: the sum of its neighbours' places and then its own, and corners of triangles there: the last one,
 * and how many there are. */
typedef struct {
    Point place;
    int32_t corner, degree;
} Vertex;

typedef struct {
    Py_ssize_t n, f, row_stride, stride;
    Point *w;
    const int64_t *F;
    const uint8_t *held;
    Vertex *vertices;
    /* The corner before each corner at the same vertex (3 f), or -1. */
    int32_t *before;
    /* Vertices that have gone back (n), in this order, and whether they have. */
    int32_t *back;
    uint8_t *is_back;
    Py_ssize_t gone_back;
} Smoothing;

static int64_t corner(const Smoothing *map, Py_ssize_t triangle, Py_ssize_t k)
{
    return map->F[triangle * map->row_stride + k * map->stride];
}

/* Move vertices to the middles of their neighbours, of which every one is the head of a half-edge once. */
static void move(Smoothing *map)
{
    Vertex *vertices = map->vertices;
    for (Py_ssize_t v = 0; v < map->n; v++)
        vertices[v] = (Vertex){{0, 0}, -1, 0};
    for (Py_ssize_t j = 0; j < map->f; j++) {
        const int64_t ends[] = {corner(map, j, 0), corner(map, j, 1), corner(map, j, 2), corner(map, j, 0)};
        for (int k = 0; k < 3; k++) {
            Vertex *tail = &vertices[ends[k]];
            tail->place.x += map->w[ends[k + 1]].x;
            tail->place.y += map->w[ends[k + 1]].y;
            map->before[3 * j + k] = tail->corner;
            tail->corner = (int32_t)(3 * j + k);
            tail->degree++;
        }
    }
    for (Py_ssize_t v = 0; v < map->n; v++) {
        Vertex *here = &vertices[v];
        if (here->degree && !map->held[v])
            here->place = (Point){here->place.x / here->degree, here->place.y / here->degree};
        else
            here->place = map->w[v];
    }
}

/* Let corners of a triangle go back if it is not positive. */
static void look_at(Smoothing *map, Py_ssize_t triangle)
{
    const int64_t ends[] = {corner(map, triangle, 0), corner(map, triangle, 1), corner(map, triangle, 2)};
    const Point at = map->vertices[ends[0]].place;
    const Point one = difference(map->vertices[ends[1]].place, at), other = difference(map->vertices[ends[2]].place, at);
    if (one.x * other.y - one.y * other.x > 0)
        return;
    for (int k = 0; k < 3; k++)
        if (!map->is_back[ends[k]]) {
            map->is_back[ends[k]] = 1;
            map->back[map->gone_back++] = (int32_t)ends[k];
        }
}

/* Move vertices back until no triangle is inverted that was not before. */
static void move_back(Smoothing *map)
{
    for (Py_ssize_t j = 0; j < map->f; j++)
        look_at(map, j);
    for (Py_ssize_t from = 0, until = map->gone_back; from < until; from = until, until = map->gone_back) {
        for (Py_ssize_t i = from; i < until; i++)
            map->vertices[map->back[i]].place = map->w[map->back[i]];
        for (Py_ssize_t i = from; i < until; i++)
            for (int32_t c = map->vertices[map->back[i]].corner; c >= 0; c = map->before[c])
                look_at(map, c / 3);
    }
}

/* (w, F, held): every vertex moved to the middle of its neighbours, unless it inverts a triangle. */
static PyObject *smooth(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[3];
    if (!take("smooth", given, count, "Z~qb", a))
        return NULL;
    if (!fit("smooth", a, LENGTH(a),
             a[1].columns == 3 && a[1].rows <= INT32_MAX / 3 && a[2].size == a[0].size))
        return NULL;
    const size_t n = (size_t)a[0].size + 1, f = (size_t)a[1].rows + 1;
    Smoothing map = {
        .n = a[0].size, .f = a[1].rows, .row_stride = a[1].row_stride, .stride = a[1].stride,
        .w = a[0].data, .F = a[1].data, .held = a[2].data,
        .vertices = malloc(n * sizeof(Vertex)), .before = malloc(3 * f * sizeof(int32_t)),
        .back = malloc(n * sizeof(int32_t)), .is_back = calloc(n, 1),
    };
    const int enough = map.vertices && map.before && map.back && map.is_back;
    if (enough) {
        Py_BEGIN_ALLOW_THREADS
        move(&map);
        move_back(&map);
        for (Py_ssize_t v = 0; v < map.n; v++)
            map.w[v] = map.vertices[v].place;
        Py_END_ALLOW_THREADS
    }
    free(map.vertices);
    free(map.before);
    free(map.back);
    free(map.is_back);
    return enough ? done(a, LENGTH(a)) : out_of_memory(a, LENGTH(a));
}

PyMethodDef prolongation_kernels[] = {KERNEL(find_places), KERNEL(smooth), END_OF_KERNELS};
