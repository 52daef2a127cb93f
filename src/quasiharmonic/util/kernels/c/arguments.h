/* What kernels are handed: arrays by the buffer protocol, and numbers. */
#ifndef QUASIHARMONIC_ARGUMENTS_H
#define QUASIHARMONIC_ARGUMENTS_H

#include "constants.h"

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>

/* One argument: an array (data, and size in items), or a number. */
typedef struct {
    void *data;
    Py_ssize_t size;
    /* Of the last axis and all before it taken as one; strides in items. Of a contiguous array the row's stride is the
       length of the last axis, and the stride 1. */
    Py_ssize_t rows, columns, row_stride, stride;
    Py_ssize_t integer;
    double number;
    Py_buffer view;
    int held, written;
    /* The copy of an array of int32 that stands for int64; written back at the end if the kernel writes to it. */
    int64_t *wide;
} Argument;

/* Read the arguments of a kernel, a letter each:
 *
 *     d float64   z complex128   q int64   i int32   u uint32   b bool, int8 or uint8     arrays, contiguous in C's order
 *     q may also be int32, which is copied
 *     the same in upper case                                                              arrays that are written to
 *     ~ before a letter                                                                   with any strides, of two axes at most
 *     n integer   x float                                                                 numbers
 *
 * 1 when all is well; 0 with a TypeError set, and nothing held. */
int take(const char *kernel, PyObject *const *given, Py_ssize_t count, const char *kinds, Argument *arguments);

/* 1 where arrays fit together, as a kernel says; else 0 with a ValueError set, and nothing held. */
int fit(const char *kernel, Argument *arguments, Py_ssize_t count, int fits);

/* Whether these int64 are where parts of so many items begin, one after another, and where the last one ends. */
int are_parts(const Argument *starts, Py_ssize_t items);

/* Whether each of these int64 is the number of one of so many items. */
int are_indices(const Argument *numbers, Py_ssize_t items);

/* Let the arrays go. None, for a kernel to return. */
PyObject *done(Argument *arguments, Py_ssize_t count);

/* The same where a number is the kernel's answer. */
PyObject *done_with_integer(Argument *arguments, Py_ssize_t count, Py_ssize_t answer);
PyObject *done_with_number(Argument *arguments, Py_ssize_t count, double answer);

/* The same where there was no memory: NULL, with a MemoryError set. */
PyObject *out_of_memory(Argument *arguments, Py_ssize_t count);

#define KERNEL(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, "As its twin in NumPy."}
#define END_OF_KERNELS {NULL, NULL, 0, NULL}
#define LENGTH(array) ((Py_ssize_t)(sizeof(array) / sizeof((array)[0])))

#endif
