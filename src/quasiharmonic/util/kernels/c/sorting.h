/* Short rows of whole numbers, sorted: by insertion where there are few, as nearly always, else by the library. */
#ifndef QUASIHARMONIC_SORTING_H
#define QUASIHARMONIC_SORTING_H

#include <stdint.h>
#include <stdlib.h>

/* Numbers from which on a row is sorted by the library. */
#define MANY 24

/* Defines a function that sorts numbers of a type, given their size. */
#define DEFINE_SORT(sort, number) \
    static int sort##_compares(const void *one, const void *other) \
    { \
        const number a = *(const number *)one, b = *(const number *)other; \
        return (a > b) - (a < b); \
    } \
    static void sort(number *numbers, int64_t size) \
    { \
        if (size >= MANY) { \
            qsort(numbers, (size_t)size, sizeof(*numbers), sort##_compares); \
            return; \
        } \
        for (int64_t k = 1; k < size; k++) { \
            const number here = numbers[k]; \
            int64_t place = k; \
            for (; place > 0 && numbers[place - 1] > here; place--) \
                numbers[place] = numbers[place - 1]; \
            numbers[place] = here; \
        } \
    }

#endif
