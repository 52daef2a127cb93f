#include "arguments.h"

#include <ctype.h>
#include <string.h>

/* Formats of buffers, as NumPy and `struct` write them, and the size of an item, by the letter of a kind. */
static int fits(char kind, const char *format, Py_ssize_t itemsize)
{
    /* Arrays that came from `ctypes` name the order of their bytes, which may be this machine's. */
    const uint16_t one = 1;
    const char own_order = *(const unsigned char *)&one ? '<' : '>';
    if (*format == '@' || *format == '=' || *format == own_order)
        format++;
    switch (kind) {
    case 'd':
        /* A long double ('g') has 8 bytes on Windows and on Apple Arm. */
        return (!strcmp(format, "d") || !strcmp(format, "g")) && itemsize == 8;
    case 'z':
        return (!strcmp(format, "Zd") || !strcmp(format, "Zg")) && itemsize == 16;
    case 'q':
        return (*format == 'q' || *format == 'l' || *format == 'i') && !format[1] && (itemsize == 8 || itemsize == 4);
    case 'i':
        return (*format == 'i' || *format == 'l') && !format[1] && itemsize == 4;
    case 'u':
        return (*format == 'I' || *format == 'L') && !format[1] && itemsize == 4;
    case 'b':
        return (*format == '?' || *format == 'b' || *format == 'B') && !format[1];
    default:
        return 0;
    }
}

/* The item of an array of int32 at a row and a column of `Argument`, as the buffer has it. */
static int32_t *narrow(const Argument *array, Py_ssize_t row, Py_ssize_t column)
{
    const Py_buffer *view = &array->view;
    Py_ssize_t stride = view->ndim > 0 && view->strides ? view->strides[view->ndim - 1] : view->itemsize;
    Py_ssize_t row_stride = view->ndim > 1 && view->strides ? view->strides[view->ndim - 2] : array->columns * view->itemsize;
    return (int32_t *)((char *)view->buf + row * row_stride + column * stride);
}

/* Make a contiguous copy of an array of int32 as int64: default integers have 32 bits on Windows with NumPy 1. */
static int widen(Argument *array)
{
    Py_ssize_t size = array->size > 0 ? array->size : 1;
    array->wide = PyMem_Malloc((size_t)size * sizeof(int64_t));
    if (!array->wide) {
        PyErr_NoMemory();
        return 0;
    }
    for (Py_ssize_t row = 0; row < array->rows; row++)
        for (Py_ssize_t column = 0; column < array->columns; column++)
            array->wide[row * array->columns + column] = *narrow(array, row, column);
    array->data = array->wide;
    array->row_stride = array->columns;
    array->stride = 1;
    return 1;
}

/* Let the arrays go, and write copies back: kernels write indices and counts, which fit into the caller's 32 bits. */
static void release(Argument *arguments, Py_ssize_t count)
{
    for (Py_ssize_t i = 0; i < count; i++) {
        const Argument *array = &arguments[i];
        if (!array->held)
            continue;
        if (array->wide && array->written)
            for (Py_ssize_t row = 0; row < array->rows; row++)
                for (Py_ssize_t column = 0; column < array->columns; column++)
                    *narrow(array, row, column) = (int32_t)array->wide[row * array->columns + column];
        PyMem_Free(array->wide);
        PyBuffer_Release(&arguments[i].view);
    }
}

/* An array's data and shape. */
static int take_array(PyObject *given, char letter, int strided, Argument *to)
{
    int flags = PyBUF_FORMAT | (strided ? PyBUF_STRIDES : PyBUF_C_CONTIGUOUS);
    if (isupper((unsigned char)letter))
        flags |= PyBUF_WRITABLE;
    if (PyObject_GetBuffer(given, &to->view, flags) < 0)
        return 0;
    to->held = 1;
    to->wide = NULL;
    to->written = flags & PyBUF_WRITABLE;
    const Py_buffer *view = &to->view;
    char kind = (char)tolower((unsigned char)letter);
    if (!fits(kind, view->format ? view->format : "B", view->itemsize)) {
        PyErr_Format(PyExc_TypeError, "holds items of the format '%s'", view->format ? view->format : "B");
        return 0;
    }
    if ((uintptr_t)view->buf % (uintptr_t)(view->itemsize > 8 ? 8 : view->itemsize)) {
        PyErr_SetString(PyExc_TypeError, "is not aligned");
        return 0;
    }
    to->data = view->buf;
    to->size = view->itemsize ? view->len / view->itemsize : 0;
    to->rows = to->columns = to->row_stride = to->stride = 1;
    if (view->ndim > 0) {
        int last = view->ndim - 1;
        to->columns = view->shape[last];
        to->rows = 1;
        for (int axis = 0; axis < last; axis++)
            to->rows *= view->shape[axis];
        to->row_stride = to->columns;
        if (strided) {
            if (view->ndim > 2) {
                PyErr_SetString(PyExc_TypeError, "has more than two axes");
                return 0;
            }
            for (int axis = 0; axis <= last; axis++)
                if (view->strides[axis] % view->itemsize) {
                    PyErr_SetString(PyExc_TypeError, "has strides of parts of items");
                    return 0;
                }
            to->stride = view->strides[last] / view->itemsize;
            to->row_stride = last ? view->strides[0] / view->itemsize : 0;
        }
    }
    return kind == 'q' && view->itemsize == 4 ? widen(to) : 1;
}

int take(const char *kernel, PyObject *const *given, Py_ssize_t count, const char *kinds, Argument *arguments)
{
    Py_ssize_t read = 0;
    const char *letter = kinds;
    for (; *letter; letter++, read++) {
        int strided = *letter == '~';
        letter += strided;
        Argument *to = &arguments[read];
        to->held = 0;
        if (read >= count)
            break;
        if (*letter == 'n') {
            to->integer = PyNumber_AsSsize_t(given[read], PyExc_OverflowError);
            if (to->integer == -1 && PyErr_Occurred())
                goto wrong;
        } else if (*letter == 'x') {
            to->number = PyFloat_AsDouble(given[read]);
            if (to->number == -1 && PyErr_Occurred())
                goto wrong;
        } else if (!take_array(given[read], *letter, strided, to)) {
            read++;
            goto wrong;
        }
    }
    if (!*letter && read == count)
        return 1;
    release(arguments, read);
    PyErr_Format(PyExc_TypeError, "the kernel %s was given %zd arguments", kernel, count);
    return 0;

wrong:
    release(arguments, read);
    PyObject *type, *value, *traceback;
    PyErr_Fetch(&type, &value, &traceback);
    PyErr_NormalizeException(&type, &value, &traceback);
    PyErr_Format(PyExc_TypeError, "an argument of the kernel %s (of the kinds \"%s\"): %S", kernel, kinds, value);
    Py_XDECREF(type);
    Py_XDECREF(value);
    Py_XDECREF(traceback);
    return 0;
}

int fit(const char *kernel, Argument *arguments, Py_ssize_t count, int fits)
{
    if (fits)
        return 1;
    release(arguments, count);
    PyErr_Format(PyExc_ValueError, "arrays given to the kernel %s do not fit together", kernel);
    return 0;
}

int are_parts(const Argument *starts, Py_ssize_t items)
{
    const int64_t *at = starts->data;
    if (!starts->size || at[0] < 0 || at[starts->size - 1] > items)
        return 0;
    for (Py_ssize_t i = 1; i < starts->size; i++)
        if (at[i] < at[i - 1])
            return 0;
    return 1;
}

int are_indices(const Argument *numbers, Py_ssize_t items)
{
    const int64_t *at = numbers->data;
    int inside = 1;
    for (Py_ssize_t i = 0; i < numbers->size; i++)
        inside &= 0 <= at[i] && at[i] < items;
    return inside;
}

PyObject *done(Argument *arguments, Py_ssize_t count)
{
    release(arguments, count);
    Py_INCREF(Py_None);
    return Py_None;
}

PyObject *done_with_integer(Argument *arguments, Py_ssize_t count, Py_ssize_t answer)
{
    release(arguments, count);
    return PyLong_FromSsize_t(answer);
}

PyObject *done_with_number(Argument *arguments, Py_ssize_t count, double answer)
{
    release(arguments, count);
    return PyFloat_FromDouble(answer);
}

PyObject *out_of_memory(Argument *arguments, Py_ssize_t count)
{
    release(arguments, count);
    return PyErr_NoMemory();
}
