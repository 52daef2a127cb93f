/* A heap of nodes by their distances, for shortest paths. */
#ifndef QUASIHARMONIC_HEAP_H
#define QUASIHARMONIC_HEAP_H

#include <stdint.h>

typedef struct {
    double distance;
    int64_t node;
} Entry;

typedef struct {
    Entry *entries;
    int64_t size;
} Heap;

static inline int comes_before(Entry one, Entry other)
{
    return one.distance < other.distance || (one.distance == other.distance && one.node < other.node);
}

static inline void push(Heap *heap, Entry entry)
{
    Entry *entries = heap->entries;
    int64_t at = heap->size++;
    for (; at > 0 && comes_before(entry, entries[(at - 1) / 2]); at = (at - 1) / 2)
        entries[at] = entries[(at - 1) / 2];
    entries[at] = entry;
}

static inline Entry pop(Heap *heap)
{
    Entry *entries = heap->entries;
    const Entry first = entries[0], last = entries[--heap->size];
    int64_t at = 0;
    for (;;) {
        int64_t child = 2 * at + 1;
        if (child >= heap->size)
            break;
        if (child + 1 < heap->size && comes_before(entries[child + 1], entries[child]))
            child++;
        if (!comes_before(entries[child], last))
            break;
        entries[at] = entries[child];
        at = child;
    }
    entries[at] = last;
    return first;
}

#endif
