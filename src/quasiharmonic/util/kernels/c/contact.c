/* Kernel of `apps/atlas/packing/contact.py`. */
#include "arguments.h"

#include <stdlib.h>
#include <string.h>

/* Cells of a board, 64 in a word, the lowest bit first. At level l, a bit says whether any of the 2^l cells from there
 * on is occupied. Every row ends with a word of zeros. */
typedef struct {
    int64_t rows, columns, words, levels;
    uint64_t *near;
    /* Number of occupied cells before each cell of a row. */
    int32_t *before;
} Board;

/* A bitmap: the cells of row `runs[0]` from `runs[1]` to before `runs[2]`, and so on. */
typedef struct {
    const int64_t *runs;
    int64_t count, height, width;
} Bitmap;

static uint64_t *row_of(const Board *board, int64_t level, int64_t row)
{
    return board->near + (level * board->rows + row) * (board->words + 1);
}

/* 64 bits of a row from a bit on. */
static uint64_t bits_from(const uint64_t *row, int64_t words, int64_t bit)
{
    const int64_t word = bit / 64, shift = bit % 64;
    if (word >= words)
        return 0;
    return shift ? row[word] >> shift | row[word + 1] << (64 - shift) : row[word];
}

static void read_board(Board *board, const char *cells)
{
    const int64_t words = board->words;
    memset(board->near, 0, (size_t)(board->levels * board->rows * (words + 1)) * sizeof(*board->near));
    for (int64_t i = 0; i < board->rows; i++) {
        const char *from = cells + i * board->columns;
        uint64_t *row = row_of(board, 0, i);
        int32_t *before = board->before + i * (board->columns + 1), sum = 0;
        for (int64_t j = 0; j < board->columns; j++) {
            before[j] = sum;
            row[j / 64] |= (uint64_t)(from[j] != 0) << (j % 64);
            sum += from[j] != 0;
        }
        before[board->columns] = sum;
    }
    for (int64_t level = 1; level < board->levels; level++)
        for (int64_t i = 0; i < board->rows; i++) {
            const uint64_t *half = row_of(board, level - 1, i);
            uint64_t *row = row_of(board, level, i);
            for (int64_t w = 0; w < words; w++)
                row[w] = half[w] | bits_from(half, words, 64 * w + ((int64_t)1 << (level - 1)));
        }
}

/* Mark the columns of a row where a bitmap would overlap occupied cells. */
static void find_collisions(const Board *board, const Bitmap *bitmap, int64_t row, uint64_t *found)
{
    const int64_t places = board->columns - bitmap->width + 1, words = (places + 63) / 64;
    const uint64_t none = ~(uint64_t)0, last = places % 64 ? none >> (64 - places % 64) : none;
    memset(found, 0, (size_t)words * sizeof(*found));
    found[words - 1] = ~last;
    for (int64_t k = 0; k < bitmap->count; k++) {
        const int64_t *run = bitmap->runs + 3 * k;
        int64_t level = 0;
        while ((int64_t)2 << level <= run[2] - run[1])
            level++;
        const uint64_t *near = row_of(board, level, row + run[0]);
        const int64_t end = run[2] - ((int64_t)1 << level);
        uint64_t all = none;
        for (int64_t w = 0; w < words; w++) {
            found[w] |= bits_from(near, board->words, 64 * w + run[1]) | bits_from(near, board->words, 64 * w + end);
            all &= found[w];
        }
        if (all == none)
            return;
    }
}

/* The number of a bitmap's cells that would be in occupied cells. */
static int64_t count_overlap(const Board *board, const Bitmap *bitmap, int64_t row, int64_t column)
{
    int64_t sum = 0;
    for (int64_t k = 0; k < bitmap->count; k++) {
        const int64_t *run = bitmap->runs + 3 * k;
        const int32_t *before = board->before + (row + run[0]) * (board->columns + 1) + column;
        sum += before[run[2]] - before[run[1]];
    }
    return sum;
}

static int is_free(const uint64_t *collisions, int64_t column)
{
    return !(collisions[column / 64] >> (column % 64) & 1);
}

/* Find the free place with the most contact, at least one cell away from the sides; its contact, or -1. `three` has room
 * for the collisions of three rows. */
static int64_t find_place(const Board *board, const Bitmap *bitmap, uint64_t *three, int64_t *place)
{
    const int64_t last_row = board->rows - bitmap->height, last_column = board->columns - bitmap->width;
    const int64_t words = board->words + 1;
    int64_t best = -1;
    if (last_row < 2 || last_column < 2)
        return best;
    uint64_t *below = three, *here = three + words, *above = three + 2 * words;
    find_collisions(board, bitmap, 0, below);
    find_collisions(board, bitmap, 1, here);
    for (int64_t i = 1; i < last_row; i++) {
        find_collisions(board, bitmap, i + 1, above);
        for (int64_t w = 0; w <= (last_column - 1) / 64; w++) {
            uint64_t free_here = ~here[w];
            if (w == 0)
                free_here &= ~(uint64_t)1;
            if (!free_here)
                continue;
            for (int64_t j = 64 * w; j < 64 * w + 64 && j < last_column; j++) {
                if (!(free_here >> (j % 64) & 1))
                    continue;
                int64_t contact = 0;
                if (!is_free(above, j))
                    contact += count_overlap(board, bitmap, i + 1, j);
                if (!is_free(below, j))
                    contact += count_overlap(board, bitmap, i - 1, j);
                if (!is_free(here, j + 1))
                    contact += count_overlap(board, bitmap, i, j + 1);
                if (!is_free(here, j - 1))
                    contact += count_overlap(board, bitmap, i, j - 1);
                if (contact > best) {
                    best = contact;
                    place[0] = i;
                    place[1] = j;
                }
            }
        }
        uint64_t *spare = below;
        below = here;
        here = above;
        above = spare;
    }
    return best;
}

/* (occupied, rows, runs, starts, sizes, spot): the number of a bitmap and its place of most contact; 0 if there is none.
 * The runs of a bitmap are in its box. */
static PyObject *find_contact(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Argument a[6];
    if (!take("find_contact", given, count, "bnqqqQ", a))
        return NULL;
    const Py_ssize_t rows = a[1].integer, bitmaps = a[3].size - 1;
    if (!fit("find_contact", a, LENGTH(a),
             rows > 0 && a[0].size % rows == 0 && a[0].size > 0 && a[0].size <= INT32_MAX && a[2].size % 3 == 0
                 && bitmaps >= 0 && a[4].size == 2 * bitmaps && a[5].size == 3 && are_parts(&a[3], a[2].size / 3)))
        return NULL;
    const int64_t *runs = a[2].data, *starts = a[3].data, *sizes = a[4].data;
    int64_t *spot = a[5].data;
    const int64_t columns = a[0].size / rows;
    Board board = {rows, columns, (columns + 63) / 64, 1, NULL, NULL};
    while ((int64_t)1 << board.levels <= columns)
        board.levels++;
    board.near = malloc((size_t)(board.levels * rows * (board.words + 1)) * sizeof(*board.near));
    board.before = malloc((size_t)(rows * (columns + 1)) * sizeof(*board.before));
    uint64_t *three = malloc((size_t)(3 * (board.words + 1)) * sizeof(*three));
    if (!board.near || !board.before || !three) {
        free(board.near);
        free(board.before);
        free(three);
        return out_of_memory(a, LENGTH(a));
    }
    int found = 0;
    Py_BEGIN_ALLOW_THREADS
    read_board(&board, a[0].data);
    double best = -1;
    for (Py_ssize_t k = 0; k < bitmaps; k++) {
        const Bitmap bitmap = {runs + 3 * starts[k], starts[k + 1] - starts[k], sizes[2 * k], sizes[2 * k + 1]};
        int64_t place[2] = {0, 0};
        const int64_t contact = find_place(&board, &bitmap, three, place);
        const double share = (double)contact / (double)(bitmap.height + bitmap.width);
        if (contact >= 0 && share > best) {
            best = share;
            found = 1;
            spot[0] = k;
            spot[1] = place[0];
            spot[2] = place[1];
        }
    }
    Py_END_ALLOW_THREADS
    free(board.near);
    free(board.before);
    free(three);
    return done_with_integer(a, LENGTH(a), found);
}

PyMethodDef contact_kernels[] = {KERNEL(find_contact), END_OF_KERNELS};
