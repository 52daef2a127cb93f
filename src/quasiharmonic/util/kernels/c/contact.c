/* Kernel of `apps/atlas/packing/board.py`. */
#include "arguments.h"

#include <stdlib.h>
#include <string.h>

/* Cells of a board, 64 in a word, the lowest bit first. At level l, a bit says whether any of the 2^l cells from there
 * on is occupied. Every row ends with a word of zeros. */
typedef struct {
    int64_t rows, columns, words, levels;
    uint64_t *near;
} Board;

/* A run of cells of a bitmap: its row, first column and end, and two places from where the bits of a board say which of
 * its cells are occupied: words from the first row and column on, and bits from there on. */
typedef struct {
    int64_t row, first, end, words[2], bits[2];
} Run;

/* Cells beside a bitmap, as numbers of bits of a board from the bitmap's place on. */
typedef struct {
    int64_t count, *bits;
} Cells;

/* A bitmap: the longest runs first, and the cells that it would cover in addition if it was shifted by one cell: to the
 * right, to the left, up and down. */
typedef struct {
    const Run *runs;
    int64_t count, height, width;
    Cells beside[4];
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
    return row[word] >> shift | row[word + 1] << 1 << (63 - shift);
}

/* Which of eight cells are occupied, the first one in the lowest bit. */
static uint64_t read_eight(const unsigned char *cells)
{
    const uint64_t low = 0x7f7f7f7f7f7f7f7fu;
    uint64_t bytes = 0;
    for (int k = 0; k < 8; k++)
        bytes |= (uint64_t)cells[k] << 8 * k;
    /* The highest bit of each byte that is not zero, moved to the lowest one. */
    bytes = (bytes | ((bytes & low) + low)) >> 7 & 0x0101010101010101u;
    /* The product's highest byte collects bit 8 k at its bit k. */
    return bytes * 0x0102040810204080u >> 56;
}

static void read_board(Board *board, const unsigned char *cells)
{
    const int64_t words = board->words;
    memset(board->near, 0, (size_t)(board->levels * board->rows * (words + 1)) * sizeof(*board->near));
    for (int64_t i = 0; i < board->rows; i++) {
        const unsigned char *from = cells + i * board->columns;
        uint64_t *row = row_of(board, 0, i);
        int64_t j = 0;
        for (; j + 8 <= board->columns; j += 8)
            row[j / 64] |= read_eight(from + j) << j % 64;
        for (; j < board->columns; j++)
            row[j / 64] |= (uint64_t)(from[j] != 0) << j % 64;
    }
    for (int64_t level = 1; level < board->levels; level++)
        for (int64_t i = 0; i < board->rows; i++) {
            const uint64_t *half = row_of(board, level - 1, i);
            uint64_t *row = row_of(board, level, i);
            for (int64_t w = 0; w < words; w++)
                row[w] = half[w] | bits_from(half, words, 64 * w + ((int64_t)1 << (level - 1)));
        }
}

/* Fill in runs (row, first column, end), `count` of them. */
static void read_runs(const Board *board, const int64_t *given, int64_t count, Run *runs)
{
    for (int64_t k = 0; k < count; k++) {
        const int64_t row = given[3 * k], first = given[3 * k + 1], end = given[3 * k + 2];
        int64_t level = 0;
        while ((int64_t)2 << level <= end - first)
            level++;
        const int64_t last = end - ((int64_t)1 << level), words = (level * board->rows + row) * (board->words + 1);
        runs[k] = (Run){row, first, end, {words + first / 64, words + last / 64}, {first % 64, last % 64}};
    }
}

/* The largest number of cells of a bitmap. */
static int64_t count_most_cells(const int64_t *runs, const int64_t *starts, int64_t bitmaps)
{
    int64_t most = 0;
    for (int64_t k = 0; k < bitmaps; k++) {
        int64_t count = 0;
        for (int64_t run = starts[k]; run < starts[k + 1]; run++) {
            const int64_t length = runs[3 * run + 2] - runs[3 * run + 1];
            /* Each run has two cells beside it, even if it had none itself. */
            count += length > 1 ? length : 1;
        }
        most = count > most ? count : most;
    }
    return most;
}

static void add_cell(Cells *cells, int64_t bit)
{
    cells->bits[cells->count++] = bit;
}

/* List the cells beside a bitmap. `cells` has room for all rows of the board and two more, and each list for all cells
 * of the bitmap. */
static void list_beside(const Board *board, Bitmap *bitmap, uint64_t *cells)
{
    const int64_t words = bitmap->width / 64 + 1, stride = 64 * (board->words + 1);
    uint64_t *rows = cells + words;
    memset(cells, 0, (size_t)((bitmap->height + 2) * words) * sizeof(*cells));
    for (int k = 0; k < 4; k++)
        bitmap->beside[k].count = 0;
    for (int64_t k = 0; k < bitmap->count; k++) {
        const Run *run = bitmap->runs + k;
        add_cell(&bitmap->beside[0], run->row * stride + run->end);
        add_cell(&bitmap->beside[1], run->row * stride + run->first - 1);
        uint64_t *row = rows + run->row * words;
        for (int64_t w = run->first / 64; w <= run->end / 64; w++) {
            const uint64_t from = w == run->first / 64 ? ~(uint64_t)0 << run->first % 64 : ~(uint64_t)0;
            row[w] |= w == run->end / 64 ? from & (((uint64_t)1 << run->end % 64) - 1) : from;
        }
    }
    for (int64_t i = 0; i < bitmap->height; i++)
        for (int64_t w = 0; w < words; w++) {
            const uint64_t *here = rows + i * words + w;
            for (int up = 0; up < 2; up++) {
                uint64_t bits = *here & ~here[up ? words : -words];
                for (int64_t j = 64 * w; bits; bits >>= 1, j++)
                    if (bits & 1)
                        add_cell(&bitmap->beside[up ? 2 : 3], (i + (up ? 1 : -1)) * stride + j);
            }
        }
}

/* Mark the columns of a row where a bitmap would overlap occupied cells. */
static void find_collisions(const Board *board, const Bitmap *bitmap, int64_t row, uint64_t *found)
{
    const int64_t places = board->columns - bitmap->width + 1, words = (places + 63) / 64;
    const uint64_t none = ~(uint64_t)0, last = places % 64 ? none >> (64 - places % 64) : none;
    for (int64_t w = 0; w < words; w++) {
        const uint64_t *near = row_of(board, 0, row) + w;
        uint64_t all = w == words - 1 ? ~last : 0;
        for (int64_t k = 0; k < bitmap->count && all != none; k++) {
            const Run *run = bitmap->runs + k;
            const uint64_t *one = near + run->words[0], *other = near + run->words[1];
            all |= one[0] >> run->bits[0] | one[1] << 1 << (63 - run->bits[0]);
            all |= other[0] >> run->bits[1] | other[1] << 1 << (63 - run->bits[1]);
        }
        found[w] = all;
    }
}

/* The number of cells beside a bitmap that are occupied, if it is more than `least`; otherwise this or a lower number. */
static int64_t count_occupied(const Board *board, Cells beside, int64_t place, int64_t least)
{
    int64_t sum = 0;
    for (int64_t k = 0; k < beside.count && sum + beside.count - k > least; k++) {
        const uint64_t bit = (uint64_t)(place + beside.bits[k]);
        sum += (int64_t)(board->near[bit / 64] >> bit % 64 & 1);
    }
    return sum;
}

/* Find the free place with the most contact, at least one cell away from the sides; its contact, or -1 if it is not
 * more than `least`. `three` has room for the collisions of three rows. */
static int64_t find_place(const Board *board, const Bitmap *bitmap, int64_t least, uint64_t *three, int64_t *place)
{
    const int64_t last_row = board->rows - bitmap->height, last_column = board->columns - bitmap->width;
    const int64_t words = board->words + 1;
    int64_t best = least;
    uint64_t *below = three, *here = three + words, *above = three + 2 * words;
    find_collisions(board, bitmap, 0, below);
    find_collisions(board, bitmap, 1, here);
    for (int64_t i = 1; i < last_row; i++) {
        find_collisions(board, bitmap, i + 1, above);
        for (int64_t w = 0; w <= (last_column - 1) / 64; w++) {
            // Bits of places where the bitmap is free, and of those where it is not if it is shifted by one cell.
            uint64_t bits = ~here[w];
            const uint64_t left = here[w] << 1 | (w ? here[w - 1] >> 63 : 1);
            const uint64_t right = here[w] >> 1 | (w < last_column / 64 ? here[w + 1] << 63 : 0);
            if (w == 0)
                bits &= ~(uint64_t)1;
            if (w == last_column / 64)
                bits &= ((uint64_t)1 << last_column % 64) - 1;
            if (best >= 0)
                bits &= above[w] | below[w] | left | right;
            for (int64_t j = 64 * w; bits; bits >>= 1, j++) {
                if (!(bits & 1))
                    continue;
                /* Shifts by one cell that are not free; each one has at most this contact. */
                const int shifts[] = {right >> j % 64 & 1, left >> j % 64 & 1, above[w] >> j % 64 & 1,
                                      below[w] >> j % 64 & 1};
                int64_t contact = 0;
                for (int k = 0; k < 4; k++)
                    contact += shifts[k] ? bitmap->beside[k].count : 0;
                for (int k = 0; k < 4 && contact > best; k++) {
                    if (!shifts[k])
                        continue;
                    contact -= bitmap->beside[k].count;
                    contact += count_occupied(board, bitmap->beside[k], 64 * words * i + j, best - contact);
                }
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
    return best > least ? best : -1;
}

/* (occupied, rows, runs, starts, sizes, spot): the number of a bitmap and its place of most contact; 0 if there is none.
 * The runs of a bitmap are in its box and have no common cells. */
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
    const int64_t *starts = a[3].data, *sizes = a[4].data;
    int64_t *spot = a[5].data;
    const int64_t columns = a[0].size / rows;
    Board board = {rows, columns, (columns + 63) / 64, 1, NULL};
    while ((int64_t)1 << board.levels <= columns)
        board.levels++;
    board.near = malloc((size_t)(board.levels * rows * (board.words + 1)) * sizeof(*board.near));
    uint64_t *three = malloc((size_t)(3 * (board.words + 1)) * sizeof(*three));
    uint64_t *cells = malloc((size_t)((rows + 2) * board.words) * sizeof(*cells));
    Run *runs = malloc((size_t)(a[2].size / 3 + 1) * sizeof(*runs));
    const int64_t most = count_most_cells(a[2].data, starts, bitmaps);
    int64_t *beside = malloc((size_t)(4 * most + 1) * sizeof(*beside));
    if (!board.near || !three || !cells || !runs || !beside) {
        free(board.near);
        free(three);
        free(cells);
        free(runs);
        free(beside);
        return out_of_memory(a, LENGTH(a));
    }
    int found = 0;
    Py_BEGIN_ALLOW_THREADS
    read_board(&board, a[0].data);
    read_runs(&board, a[2].data, a[2].size / 3, runs);
    double best = -1;
    for (Py_ssize_t k = 0; k < bitmaps; k++) {
        Bitmap bitmap = {runs + starts[k], starts[k + 1] - starts[k], sizes[2 * k], sizes[2 * k + 1], {{0, NULL}}};
        const double sides = (double)(bitmap.height + bitmap.width);
        if (bitmap.height + 2 > rows || bitmap.width + 2 > columns)
            continue;
        for (int side = 0; side < 4; side++)
            bitmap.beside[side].bits = beside + side * most;
        list_beside(&board, &bitmap, cells);
        // A bitmap with this contact or less is not better than the ones before.
        int64_t least = (int64_t)(best * sides), place[2] = {0, 0};
        while (least >= 0 && (double)least / sides > best)
            least--;
        const int64_t contact = find_place(&board, &bitmap, least, three, place);
        const double share = (double)contact / sides;
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
    free(three);
    free(cells);
    free(runs);
    free(beside);
    return done_with_integer(a, LENGTH(a), found);
}

PyMethodDef contact_kernels[] = {KERNEL(find_contact), END_OF_KERNELS};
