/* Kernels of `solver/methods/relocation.py`: relocation of the vertices of inverted triangles, mesh after mesh. */
#include "arguments.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Some vertices, ascending, and the edges opposite to each, those of vertex i from first[i] on; groups from 1 on of
   vertices that share no triangle, and 0 for those with too many triangles around them. */
typedef struct {
    Py_ssize_t count;
    int64_t *vertices, *first, *tails, *heads;
    unsigned char *group, groups;
} Stars;

/* The triangles of one mesh, among the vertices of all. */
typedef struct {
    const int64_t *F;
    Py_ssize_t triangles;
    const unsigned char *moves;
    int64_t *number; /* -1 everywhere between two uses */
} Mesh;

static void discard(Stars *stars)
{
    free(stars->vertices);
    free(stars->first);
    free(stars->tails);
    free(stars->heads);
    free(stars->group);
    memset(stars, 0, sizeof *stars);
}

static int is_positive(const int64_t *corners, const double *w)
{
    const double *w0 = w + 2 * corners[0], *w1 = w + 2 * corners[1], *w2 = w + 2 * corners[2];
    return 0.5 * ((w1[0] - w0[0]) * (w2[1] - w0[1]) - (w1[1] - w0[1]) * (w2[0] - w0[0])) > 0;
}

static int ascending(const void *one, const void *other)
{
    const int64_t a = *(const int64_t *)one, b = *(const int64_t *)other;
    return (a > b) - (a < b);
}

/* The vertices that may move of some of the mesh's triangles; the others' are left out of `corners`, which has room for
   those of all. How many there are. */
static Py_ssize_t vertices_of(const Mesh *mesh, int64_t *corners, Py_ssize_t size)
{
    Py_ssize_t count = 0;
    for (Py_ssize_t k = 0; k < size; k++)
        if (mesh->moves[corners[k]] && mesh->number[corners[k]] < 0) {
            mesh->number[corners[k]] = 0;
            corners[count++] = corners[k];
        }
    for (Py_ssize_t k = 0; k < count; k++)
        mesh->number[corners[k]] = -1;
    qsort(corners, (size_t)count, sizeof *corners, ascending);
    return count;
}

/* What is around vertices, of which there is one at least, and their groups; 0 where memory has run out. */
static int find_stars(const Mesh *mesh, const int64_t *vertices, Py_ssize_t count, Stars *stars)
{
    discard(stars);
    stars->count = count;
    stars->vertices = malloc((size_t)count * sizeof(int64_t));
    stars->first = calloc((size_t)count + 1, sizeof(int64_t));
    stars->group = calloc((size_t)count, 1);
    if (!stars->vertices || !stars->first || !stars->group)
        return 0;
    memcpy(stars->vertices, vertices, (size_t)count * sizeof(int64_t));
    for (Py_ssize_t i = 0; i < count; i++)
        mesh->number[vertices[i]] = i;
    for (Py_ssize_t k = 0; k < 3 * mesh->triangles; k++)
        if (mesh->number[mesh->F[k]] >= 0)
            stars->first[mesh->number[mesh->F[k]] + 1]++;
    for (Py_ssize_t i = 0; i < count; i++)
        stars->first[i + 1] += stars->first[i];
    const size_t edges = (size_t)stars->first[count] * sizeof(int64_t);
    stars->tails = malloc(edges ? edges : 1);
    stars->heads = malloc(edges ? edges : 1);
    const int enough = stars->tails && stars->heads;
    if (enough) {
        for (Py_ssize_t t = 0; t < mesh->triangles; t++)
            for (int corner = 0; corner < 3; corner++) {
                const int64_t *F = mesh->F + 3 * t, own = mesh->number[F[corner]];
                if (own >= 0) {
                    const int64_t at = stars->first[own]++;
                    stars->tails[at] = F[(corner + 1) % 3];
                    stars->heads[at] = F[(corner + 2) % 3];
                }
            }
        memmove(stars->first + 1, stars->first, (size_t)count * sizeof(int64_t));
        stars->first[0] = 0;
        /* In each of the triangles around a vertex the next corner is another neighbour: they are all neighbours. */
        for (Py_ssize_t i = 0; i < count; i++) {
            uint32_t taken = 0;
            if (stars->first[i + 1] - stars->first[i] > MOST_AROUND)
                continue;
            for (int64_t k = stars->first[i]; k < stars->first[i + 1]; k++) {
                const int64_t other = mesh->number[stars->tails[k]];
                if (other >= 0)
                    taken |= (uint32_t)1 << stars->group[other];
            }
            unsigned char group = 1;
            while (taken >> group & 1)
                group++;
            stars->group[i] = group;
            if (group > stars->groups)
                stars->groups = group;
        }
    }
    for (Py_ssize_t i = 0; i < count; i++)
        mesh->number[vertices[i]] = -1;
    return enough;
}

/* Where the least signed height of the triangles around a vertex is greatest. */
static void place(double *w, const int64_t *tails, const int64_t *heads, Py_ssize_t around, double *to)
{
    double x[MOST_AROUND], y[MOST_AROUND], less[MOST_AROUND], best = -INFINITY;
    for (Py_ssize_t k = 0; k < around; k++) {
        const double *tail = w + 2 * tails[k], *head = w + 2 * heads[k];
        const double along = head[0] - tail[0], up = head[1] - tail[1], length = hypot(along, up);
        /* The height of a place is the first times its x and the second times its y less the third. */
        x[k] = -up / length;
        y[k] = along / length;
        less[k] = x[k] * tail[0] + y[k] * tail[1];
    }
    for (Py_ssize_t i = 0; i < around; i++)
        for (Py_ssize_t j = i + 1; j < around; j++) {
            const double ax = x[i] - x[j], ay = y[i] - y[j], p = less[i] - less[j];
            for (Py_ssize_t l = j + 1; l < around; l++) {
                const double bx = x[i] - x[l], by = y[i] - y[l], q = less[i] - less[l];
                const double det = ax * by - ay * bx, u = (p * by - q * ay) / det, v = (ax * q - bx * p) / det;
                double least = INFINITY;
                /* What is no number is not greater either. */
                for (Py_ssize_t k = 0; k < around && least > best; k++) {
                    const double height = x[k] * u + y[k] * v - less[k];
                    least = !(height >= least) ? height : least;
                }
                if (least > best && least < INFINITY) {
                    best = least;
                    to[0] = u;
                    to[1] = v;
                }
            }
        }
}

static void place_all(const Stars *stars, double *w)
{
    for (int group = 1; group <= stars->groups; group++)
        for (Py_ssize_t i = 0; i < stars->count; i++)
            if (stars->group[i] == group) {
                const int64_t first = stars->first[i];
                place(w, stars->tails + first, stars->heads + first, stars->first[i + 1] - first,
                      w + 2 * stars->vertices[i]);
            }
}

/* Place what is inverted until nothing is, or nothing helps: 1 if nothing is inverted, -1 where memory has run out. */
static int right(const Mesh *mesh, double *w, int64_t *corners, Stars *stars)
{
    Py_ssize_t fewest = mesh->triangles + 1;
    for (int sweep = 0, in_vain = 0; sweep <= SWEEPS; sweep++) {
        Py_ssize_t left = 0;
        for (Py_ssize_t t = 0; t < mesh->triangles; t++)
            if (!is_positive(mesh->F + 3 * t, w)) {
                memcpy(corners + 3 * left, mesh->F + 3 * t, 3 * sizeof(int64_t));
                left++;
            }
        if (!left)
            return 1;
        in_vain = left < fewest ? 0 : in_vain + 1;
        fewest = left < fewest ? left : fewest;
        const Py_ssize_t count = vertices_of(mesh, corners, 3 * left);
        if (in_vain == IN_VAIN || !count || sweep == SWEEPS)
            return 0;
        if (count != stars->count || memcmp(corners, stars->vertices, (size_t)count * sizeof(int64_t)))
            if (!find_stars(mesh, corners, count, stars))
                return -1;
        place_all(stars, w);
    }
    return 0;
}

/* Place once more what has moved, together with its neighbours, so that the room is shared; 0 where memory has run
   out. */
static int share(const Mesh *mesh, const double *given, double *w, double *before, int64_t *corners, Stars *stars)
{
    Py_ssize_t size = 0;
    for (Py_ssize_t t = 0; t < mesh->triangles; t++) {
        const int64_t *F = mesh->F + 3 * t;
        for (int corner = 0; corner < 3; corner++)
            if (w[2 * F[corner]] != given[2 * F[corner]] || w[2 * F[corner] + 1] != given[2 * F[corner] + 1]) {
                memcpy(corners + size, F, 3 * sizeof(int64_t));
                size += 3;
                break;
            }
    }
    const Py_ssize_t count = vertices_of(mesh, corners, size);
    if (!count)
        return 1;
    if (!find_stars(mesh, corners, count, stars))
        return 0;
    for (Py_ssize_t i = 0; i < count; i++)
        memcpy(before + 2 * i, w + 2 * corners[i], 2 * sizeof(double));
    for (int k = 0; k < SHARING; k++)
        place_all(stars, w);
    /* No height falls below the least of those around it, but for rounding. */
    int spoilt = 0;
    for (Py_ssize_t t = 0; t < mesh->triangles; t++)
        spoilt |= !is_positive(mesh->F + 3 * t, w);
    for (Py_ssize_t i = 0; spoilt && i < count; i++)
        memcpy(w + 2 * corners[i], before + 2 * i, 2 * sizeof(double));
    return 1;
}

/* (F, moves, mesh, given, w, righted): place vertices, from where they are given, and say of which meshes no triangle
   is inverted any more. */
static PyObject *place_inverted(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("place_inverted", given, count, "qbqzZB", a))
        return NULL;
    const int64_t *F = a[0].data, *of = a[2].data;
    const Py_ssize_t f = a[2].size, n = a[3].size;
    const double *from = a[3].data;
    double *w = a[4].data;
    unsigned char *righted = a[5].data;
    if (!fit("place_inverted", a, LENGTH(a),
             a[0].size == 3 * f && a[1].size == n && a[4].size == n &&
             (!f || (of[0] >= 0 && of[f - 1] < a[5].size))))
        return NULL;
    int64_t *number = malloc((size_t)(n + 1) * sizeof(int64_t));
    int64_t *corners = malloc((size_t)(3 * f + 1) * sizeof(int64_t));
    double *before = malloc((size_t)(n + 1) * 2 * sizeof(double));
    int enough = number && corners && before;
    if (enough) {
        Py_BEGIN_ALLOW_THREADS
        Stars stars = {0};
        memcpy(w, from, (size_t)n * 2 * sizeof(double));
        memset(righted, 1, (size_t)a[5].size);
        for (Py_ssize_t i = 0; i < n; i++)
            number[i] = -1;
        for (Py_ssize_t begin = 0, end; begin < f && enough; begin = end) {
            for (end = begin + 1; end < f && of[end] == of[begin];)
                end++;
            const Mesh mesh = {F + 3 * begin, end - begin, a[1].data, number};
            discard(&stars);
            const int outcome = right(&mesh, w, corners, &stars);
            righted[of[begin]] = outcome == 1;
            enough = outcome >= 0 && (outcome == 0 || share(&mesh, from, w, before, corners, &stars));
        }
        discard(&stars);
        Py_END_ALLOW_THREADS
    }
    free(number);
    free(corners);
    free(before);
    if (!enough)
        return out_of_memory(a, LENGTH(a));
    return done(a, LENGTH(a));
}

PyMethodDef placing_kernels[] = {KERNEL(place_inverted), END_OF_KERNELS};
