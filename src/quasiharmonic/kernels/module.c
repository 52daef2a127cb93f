/* The extension: the kernels of all files, a file for each idea, as the Python files that they are for. */
#include "arguments.h"

extern PyMethodDef certificate_kernels[];
extern PyMethodDef field_kernels[];
extern PyMethodDef guard_kernels[];
extern PyMethodDef laplacian_kernels[];
extern PyMethodDef loops_kernels[];
extern PyMethodDef nested_grid_kernels[];
extern PyMethodDef pattern_kernels[];
extern PyMethodDef placing_kernels[];
extern PyMethodDef reference_kernels[];
extern PyMethodDef topology_kernels[];
extern PyMethodDef vector_adam_kernels[];

static int fill(PyObject *module)
{
    PyMethodDef *const tables[] = {
        certificate_kernels,
        field_kernels,
        guard_kernels,
        laplacian_kernels,
        loops_kernels,
        nested_grid_kernels,
        pattern_kernels,
        placing_kernels,
        reference_kernels,
        topology_kernels,
        vector_adam_kernels,
    };
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
