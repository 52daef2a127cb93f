/* The extension: the kernels of all files, a file for each idea, as the Python files that they are for. */
#include "arguments.h"

#define FILES(with) \
    with(deformation) \
    with(field) \
    with(guard) \
    with(laplacian) \
    with(loops) \
    with(mixtures) \
    with(nested_grid) \
    with(newton_system) \
    with(pattern) \
    with(placing) \
    with(point_location) \
    with(prolongation) \
    with(reference) \
    with(reweighted) \
    with(removal) \
    with(topology) \
    with(triangles) \
    with(vector_adam)

#define DECLARED(file) extern PyMethodDef file##_kernels[];
#define LISTED(file) file##_kernels,

FILES(DECLARED)

static int fill(PyObject *module)
{
    PyMethodDef *const tables[] = {FILES(LISTED)};
    for (Py_ssize_t i = 0; i < LENGTH(tables); i++)
        if (PyModule_AddFunctions(module, tables[i]) < 0)
            return -1;
    return 0;
}

static PyModuleDef_Slot slots[] = {{Py_mod_exec, (void *)fill}, {0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_compiled", "Loops of quasiharmonic, compiled.", 0, NULL, slots, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__compiled(void)
{
    return PyModuleDef_Init(&definition);
}
