/* Kernels of `linsolve/laplacian.py`, and the check of patterns of `linsolve/base.py`. */
#include "arguments.h"
#include "sorting.h"

#include <stdlib.h>
#include <string.h>

DEFINE_SORT(sort, uint64_t)

/* Triangles, the rows of their corners or -1, and how many rows there are. */
typedef struct {
    const int64_t *F;
    const int32_t *place;
    Py_ssize_t triangles, size;
} Mesh;

/* Half-edges between free vertices by their rows: where those of each row start, and their columns and numbers. */
static void by_row(const Mesh *mesh, int64_t *starts, uint64_t *inner)
{
    memset(starts, 0, (size_t)(mesh->size + 1) * sizeof(*starts));
    for (int filling = 0; filling < 2; filling++) {
        for (Py_ssize_t t = 0; t < mesh->triangles; t++) {
            const int64_t *corner = mesh->F + 3 * t;
            const int32_t at[] = {mesh->place[corner[0]], mesh->place[corner[1]], mesh->place[corner[2]]};
            for (int e = 0; e < 3; e++) {
                const int32_t one = at[e], other = at[(e + 1) % 3], low = one < other ? one : other;
                if (low < 0)
                    continue;
                if (filling)
                    inner[--starts[low]] = (uint64_t)(low == one ? other : one) << 32 | (uint64_t)(e * mesh->triangles + t);
                else
                    starts[low]++;
            }
        }
        /* Where each row ends. It is filled from behind, and then it starts there. */
        for (Py_ssize_t i = 1; i <= mesh->size && !filling; i++)
            starts[i] += starts[i - 1];
    }
}

/* List the entries, and the half-edges of each; how many there are. */
static Py_ssize_t list_entries(const Mesh *mesh, const int64_t *starts, uint64_t *inner, Argument *to)
{
    int32_t *indptr = to[0].data, *indices = to[1].data, *halves = to[4].data, *offsets = to[5].data;
    int64_t *row = to[2].data, *column = to[3].data;
    Py_ssize_t entries = 0;
    for (Py_ssize_t i = 0; i < mesh->size; i++) {
        indptr[i] = (int32_t)(i + entries);
        *indices++ = (int32_t)i;
        sort(inner + starts[i], starts[i + 1] - starts[i]);
        for (int64_t k = starts[i]; k < starts[i + 1]; k++) {
            const int64_t next = (int64_t)(inner[k] >> 32);
            if (k == starts[i] || next != column[entries - 1]) {
                row[entries] = i;
                column[entries] = next;
                offsets[entries++] = (int32_t)k;
                *indices++ = (int32_t)next;
            }
            halves[k] = (int32_t)(inner[k] & 0xffffffffu);
        }
    }
    indptr[mesh->size] = (int32_t)(mesh->size + entries);
    offsets[entries] = (int32_t)starts[mesh->size];
    return entries;
}

/* List half-edges between a free and a fixed vertex; how many there are. */
static Py_ssize_t list_border(const Mesh *mesh, int64_t *border, int64_t *border_row, int64_t *border_fixed)
{
    Py_ssize_t listed = 0;
    for (int e = 0; e < 3; e++)
        for (Py_ssize_t t = 0; t < mesh->triangles; t++) {
            const int64_t tail = mesh->F[3 * t + e], head = mesh->F[3 * t + (e + 1) % 3];
            const int32_t one = mesh->place[tail], other = mesh->place[head];
            if ((one < 0) == (other < 0))
                continue;
            border[listed] = e * mesh->triangles + t;
            border_row[listed] = one < 0 ? other : one;
            border_fixed[listed++] = one < 0 ? tail : head;
        }
    return listed;
}

/* (F, place, indptr, indices, row, column, halves, offsets, border, border_row, border_fixed, sizes): the pattern of a
 * Laplacian. */
static PyObject *find_pattern(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[12];
    if (!take("find_pattern", given, count, "qiIIQQIIQQQQ", a))
        return NULL;
    const Mesh mesh = {a[0].data, a[1].data, a[0].size / 3, a[2].size - 1};
    if (!fit("find_pattern", a, LENGTH(a),
             a[0].size % 3 == 0 && mesh.size >= 0 && mesh.size + a[0].size <= INT32_MAX &&
             a[3].size >= mesh.size + a[0].size && a[4].size >= a[0].size && a[5].size >= a[0].size &&
             a[6].size >= a[0].size && a[7].size > a[0].size && a[8].size >= a[0].size &&
             a[9].size >= a[0].size && a[10].size >= a[0].size && a[11].size == 3))
        return NULL;
    int64_t *starts = malloc((size_t)(mesh.size + 1) * sizeof(*starts));
    uint64_t *inner = malloc((size_t)(3 * mesh.triangles + 1) * sizeof(*inner));
    if (!starts || !inner) {
        free(starts);
        free(inner);
        return out_of_memory(a, LENGTH(a));
    }
    int64_t *sizes = a[11].data;
    Py_BEGIN_ALLOW_THREADS
    by_row(&mesh, starts, inner);
    sizes[0] = list_entries(&mesh, starts, inner, a + 2);
    sizes[1] = starts[mesh.size];
    sizes[2] = list_border(&mesh, a[8].data, a[9].data, a[10].data);
    Py_END_ALLOW_THREADS
    free(starts);
    free(inner);
    return done(a, LENGTH(a));
}

static int wrong(const int32_t *indptr, const int32_t *indices, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        if (indptr[i + 1] <= indptr[i])
            return PATTERN_EMPTY_ROW;
    for (Py_ssize_t i = 0; i < n; i++)
        if (indices[indptr[i]] != i)
            return PATTERN_NO_DIAGONAL;
    for (Py_ssize_t i = 0; i < n; i++) {
        for (int32_t k = indptr[i] + 1; k < indptr[i + 1]; k++)
            if (indices[k] <= indices[k - 1])
                return PATTERN_NOT_ASCENDING;
        if (indices[indptr[i + 1] - 1] >= n)
            return PATTERN_NOT_ASCENDING;
    }
    return PATTERN_RIGHT;
}

/* (indptr, indices): what is wrong with an upper triangle's rows, which are known to begin with 0 and to end with the
 * number of entries. */
static PyObject *wrong_pattern(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[2];
    if (!take("wrong_pattern", given, count, "ii", a))
        return NULL;
    if (!fit("wrong_pattern", a, LENGTH(a),
             a[0].size > 0 && ((const int32_t *)a[0].data)[0] == 0 &&
             ((const int32_t *)a[0].data)[a[0].size - 1] == a[1].size))
        return NULL;
    int found;
    Py_BEGIN_ALLOW_THREADS
    found = wrong(a[0].data, a[1].data, a[0].size - 1);
    Py_END_ALLOW_THREADS
    return done_with_integer(a, LENGTH(a), found);
}

PyMethodDef pattern_kernels[] = {KERNEL(find_pattern), KERNEL(wrong_pattern), END_OF_KERNELS};
