/* The extension: the kernels of all files, a file for each idea, as the Python files that they are for. */
#include "arguments.h"

extern PyMethodDef prolongation_kernels[];
extern PyMethodDef reference_kernels[];
extern PyMethodDef removal_kernels[];

static int fill(PyObject *module)
{
    PyMethodDef *const tables[] = {prolongation_kernels, reference_kernels, removal_kernels};
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
