/* Kernels of `geometry/coarsening.py`: one round of coarsening.
 *
 * Each vertex has a star: for each triangle around it the two other corners, counterclockwise. Half-edges are never
 * sorted: whether two vertices are neighbours is looked up in a star, of six triangles as a rule.
 */
#include "arguments.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    int32_t tail, head;
} Wing;

/* A new edge that a fan claims, in the list of its smaller end. */
typedef struct {
    int32_t other, next;
} Claim;

typedef struct {
    Py_ssize_t n, f;
    const int64_t *T;
    const uint8_t *free;
    const double *dice;
    /* Where the stars start (n + 1), and they themselves (3 f). */
    int32_t *start;
    Wing *stars;
    /* In which order vertices are to go (n); infinite for those that are not to, or that are chosen or beside a chosen one. */
    double *order;
    /* Which apex to prefer (n); infinite for held vertices. */
    double *burden;
    /* Chosen vertices, in the end by degree (n). */
    int32_t *chosen;
    Py_ssize_t number;
    /* The last claim of each vertex (n), or -1, and all claims (f). */
    int32_t *last;
    Claim *claims;
    Py_ssize_t claimed;
    /* Room for marks of vertices (n), all 0. */
    uint8_t *marks;
} Round;

static Py_ssize_t degree(const Round *round, int64_t vertex)
{
    return round->start[vertex + 1] - round->start[vertex];
}

/* Stars of all vertices, by counting. */
static void gather_stars(Round *round)
{
    const Py_ssize_t n = round->n, f = round->f;
    const int64_t *T = round->T;
    int32_t *start = round->start;
    memset(start, 0, (size_t)(n + 1) * sizeof(*start));
    for (Py_ssize_t i = 0; i < 3 * f; i++)
        start[T[i]]++;
    /* Where each star ends. It is filled from behind, and then it starts there. */
    for (Py_ssize_t v = 1; v <= n; v++)
        start[v] += start[v - 1];
    for (Py_ssize_t j = 0; j < f; j++) {
        const int32_t a = (int32_t)T[j], b = (int32_t)T[f + j], c = (int32_t)T[2 * f + j];
        round->stars[--start[a]] = (Wing){b, c};
        round->stars[--start[b]] = (Wing){c, a};
        round->stars[--start[c]] = (Wing){a, b};
    }
}

/* Choose free vertices of few neighbours, each of which comes before all its neighbours; in further passes those that are
 * neighbours of chosen ones no longer count. */
static void choose(Round *round)
{
    double *order = round->order;
    for (Py_ssize_t v = 0; v < round->n; v++) {
        const Py_ssize_t d = degree(round, v);
        order[v] = round->free[v] && d && d <= MOST_NEIGHBOURS ? round->dice[v] + PER_NEIGHBOUR * (double)d : INFINITY;
        round->burden[v] = round->free[v] ? (double)d + round->dice[v] : INFINITY;
    }
    for (int pass = 0; pass < PASSES; pass++) {
        const Py_ssize_t before = round->number;
        for (Py_ssize_t v = 0; v < round->n; v++) {
            if (order[v] == INFINITY)
                continue;
            const Wing *const end = round->stars + round->start[v + 1];
            double soonest = INFINITY;
            for (const Wing *wing = round->stars + round->start[v]; wing < end; wing++) {
                const double at = order[wing->tail];
                soonest = at < soonest ? at : soonest;
            }
            round->chosen[round->number] = (int32_t)v;
            round->number += order[v] < soonest;
        }
        for (Py_ssize_t i = before; i < round->number; i++) {
            const int32_t v = round->chosen[i];
            order[v] = INFINITY;
            for (int32_t k = round->start[v]; k < round->start[v + 1]; k++)
                order[round->stars[k].tail] = INFINITY;
        }
    }
}

/* The neighbours of a vertex counterclockwise from that of least burden; 0 if they form no ring. Here as above all of a
 * star is looked at: which of its numbers is the least is as good as random, and to have guessed wrong takes longer. */
static int turn_around(const Round *round, int32_t vertex, int64_t *ring)
{
    const Wing *star = round->stars + round->start[vertex];
    const Py_ssize_t d = degree(round, vertex);
    double least = INFINITY;
    int32_t here = star[0].tail;
    for (Py_ssize_t k = 0; k < d; k++) {
        const double burden = round->burden[star[k].tail];
        here = burden < least ? star[k].tail : here;
        least = burden < least ? burden : least;
    }
    for (Py_ssize_t i = 0; i < d; i++) {
        int32_t next = -1;
        ring[i] = here;
        for (Py_ssize_t k = 0; k < d; k++)
            next = star[k].tail == here ? star[k].head : next;
        here = next;
    }
    return here == ring[0];
}

static int neighbours(const Round *round, int64_t one, int64_t other)
{
    for (int32_t k = round->start[one]; k < round->start[one + 1]; k++)
        if (round->stars[k].tail == other)
            return 1;
    return 0;
}

/* Claim a new edge; 0 if it has been claimed. */
static int claim(Round *round, int64_t one, int64_t other)
{
    const int64_t low = one < other ? one : other;
    const int32_t high = (int32_t)(one < other ? other : one);
    for (int32_t k = round->last[low]; k >= 0; k = round->claims[k].next)
        if (round->claims[k].other == high)
            return 0;
    round->claims[round->claimed] = (Claim){high, round->last[low]};
    round->last[low] = (int32_t)round->claimed++;
    return 1;
}

/* Whether a ring may be filled by a fan: from a free apex to free vertices, by edges that are new. */
static int fits(Round *round, const int64_t *ring, Py_ssize_t d)
{
    int good = round->burden[ring[0]] < INFINITY;
    for (Py_ssize_t i = 2; i < d - 1; i++)
        good &= round->burden[ring[i]] < INFINITY;
    if (!good)
        return 0;
    for (Py_ssize_t i = 2; i < d - 1; i++)
        good &= claim(round, ring[0], ring[i]) & !neighbours(round, ring[0], ring[i]);
    return good;
}

/* Sort what is chosen by degree, vertices of one degree in ascending order. */
static void sort_chosen(Round *round)
{
    Py_ssize_t place[MOST_NEIGHBOURS + 2] = {0};
    for (Py_ssize_t i = 0; i < round->number; i++) {
        round->marks[round->chosen[i]] = 1;
        place[degree(round, round->chosen[i]) + 1]++;
    }
    for (int d = 1; d <= MOST_NEIGHBOURS; d++)
        place[d] += place[d - 1];
    for (Py_ssize_t v = 0; v < round->n; v++)
        if (round->marks[v]) {
            round->chosen[place[degree(round, v)]++] = (int32_t)v;
            round->marks[v] = 0;
        }
}

/* Take out what is chosen and fits. Rings of vertices that are no neighbours share no triangle: they have room in f. */
static void take_out(Round *round, int64_t *vertices, int64_t *rings, int64_t *of_degree)
{
    memset(of_degree, 0, (MOST_NEIGHBOURS + 1) * sizeof(*of_degree));
    for (Py_ssize_t v = 0; v < round->n; v++)
        round->last[v] = -1;
    Py_ssize_t room = round->f;
    for (Py_ssize_t i = 0; i < round->number; i++) {
        const int32_t v = round->chosen[i];
        const Py_ssize_t d = degree(round, v);
        int64_t ring[MOST_NEIGHBOURS];
        /* Of what is no surface two may have a triangle in common. */
        if ((room -= d) < 0)
            break;
        if (d < 3 || !turn_around(round, v, ring) || !fits(round, ring, d))
            continue;
        *vertices++ = v;
        memcpy(rings, ring, (size_t)d * sizeof(*ring));
        rings += d;
        of_degree[d]++;
    }
}

/* Memory for a round; 0 if there is not enough. A ring claims fewer edges than it has triangles. */
static int reserve(Round *round)
{
    const size_t n = (size_t)round->n + 1, f = (size_t)round->f + 1;
    round->start = malloc(n * sizeof(*round->start));
    round->stars = malloc(3 * f * sizeof(*round->stars));
    round->order = malloc(n * sizeof(*round->order));
    round->burden = malloc(n * sizeof(*round->burden));
    round->chosen = malloc(n * sizeof(*round->chosen));
    round->last = malloc(n * sizeof(*round->last));
    round->claims = malloc(f * sizeof(*round->claims));
    round->marks = calloc(n, 1);
    return round->start && round->stars && round->order && round->burden && round->chosen && round->last &&
           round->claims && round->marks;
}

static void release(Round *round)
{
    free(round->start);
    free(round->stars);
    free(round->order);
    free(round->burden);
    free(round->chosen);
    free(round->last);
    free(round->claims);
    free(round->marks);
}

/* (T, free, dice, vertices, rings, of_degree): the vertices that one round takes out. */
static PyObject *remove_vertices(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("remove_vertices", given, count, "qbdQQQ", a))
        return NULL;
    if (!fit("remove_vertices", a, LENGTH(a),
             a[0].rows == 3 && a[0].size <= INT32_MAX && a[2].size == a[1].size &&
             a[3].size >= a[0].columns / 3 && a[4].size >= a[0].columns && a[5].size == MOST_NEIGHBOURS + 1))
        return NULL;
    Round round = {.n = a[1].size, .f = a[0].columns, .T = a[0].data, .free = a[1].data, .dice = a[2].data};
    if (!reserve(&round)) {
        release(&round);
        return out_of_memory(a, LENGTH(a));
    }
    Py_BEGIN_ALLOW_THREADS
    gather_stars(&round);
    choose(&round);
    sort_chosen(&round);
    take_out(&round, a[3].data, a[4].data, a[5].data);
    Py_END_ALLOW_THREADS
    release(&round);
    return done(a, LENGTH(a));
}

/* The fans that fill r rings of d vertices, from place k on; the place after them. */
static Py_ssize_t fill_with_fans(const int64_t *rings, int64_t r, Py_ssize_t d, int64_t *filled, Py_ssize_t f, Py_ssize_t k)
{
    for (Py_ssize_t i = 1; i < d - 1; i++)
        for (int64_t j = 0; j < r; j++, k++) {
            filled[k] = rings[j * d];
            filled[f + k] = rings[j * d + i];
            filled[2 * f + k] = rings[j * d + i + 1];
        }
    return k;
}

/* (T, there, rings, of_degree, filled): the triangles after a round. */
static PyObject *fill_rings(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[5];
    if (!take("fill_rings", given, count, "qbqqQ", a))
        return NULL;
    const int64_t *T = a[0].data, *rings = a[2].data, *of_degree = a[3].data;
    const uint8_t *there = a[1].data;
    int64_t *filled = a[4].data;
    const Py_ssize_t before = a[0].columns, after = a[4].columns;
    Py_ssize_t k = 0, stay = after, corners = 0;
    if (!fit("fill_rings", a, LENGTH(a), a[0].rows == 3 && a[4].rows == 3 && a[3].size == MOST_NEIGHBOURS + 1))
        return NULL;
    for (Py_ssize_t d = 3; d <= MOST_NEIGHBOURS; d++) {
        stay -= of_degree[d] * (d - 2);
        corners += of_degree[d] * d;
    }
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t j = 0; j < before && k <= stay; j++) {
        const int64_t one = T[j], two = T[before + j], three = T[2 * before + j];
        if (!(there[one] & there[two] & there[three]))
            continue;
        if (k < stay) {
            filled[k] = one;
            filled[after + k] = two;
            filled[2 * after + k] = three;
        }
        k++;
    }
    Py_END_ALLOW_THREADS
    /* As many must stay as leave room for the fans. */
    if (!fit("fill_rings", a, LENGTH(a), k == stay && corners <= a[2].size))
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t d = 3; d <= MOST_NEIGHBOURS; d++) {
        k = fill_with_fans(rings, of_degree[d], d, filled, after, k);
        rings += of_degree[d] * d;
    }
    Py_END_ALLOW_THREADS
    return done(a, LENGTH(a));
}

PyMethodDef removal_kernels[] = {KERNEL(remove_vertices), KERNEL(fill_rings), END_OF_KERNELS};
