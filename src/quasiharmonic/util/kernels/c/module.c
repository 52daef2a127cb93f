/* The extension module: it lists the kernels of all files. Each file has the kernels of one Python module. */
#include "arguments.h"

#define FILES(with) \
    with(contact) \
    with(deformation) \
    with(drawing) \
    with(field) \
    with(guard) \
    with(laplacian) \
    with(loops) \
    with(mixtures) \
    with(nearest_point) \
    with(nested_grid) \
    with(newton_system) \
    with(part) \
    with(paths) \
    with(pattern) \
    with(placing) \
    with(point_location) \
    with(prolongation) \
    with(reference) \
    with(reweighted) \
    with(removal) \
    with(ring) \
    with(shapes) \
    with(topology) \
    with(triangles) \
    with(vector_adam)

#define DECLARED(file) extern PyMethodDef file##_kernels[];
#define LISTED(file) file##_kernels,

FILES(DECLARED)

/* Constants for the test that compares them with the Python source. */
#define FORMAT(name) "sd"
#define VALUE(name) , #name, (double)(name)

static int fill(PyObject *module)
{
    PyMethodDef *const tables[] = {FILES(LISTED)};
    for (Py_ssize_t i = 0; i < LENGTH(tables); i++)
        if (PyModule_AddFunctions(module, tables[i]) < 0)
            return -1;
    PyObject *constants = Py_BuildValue("{" SHARED_CONSTANTS(FORMAT) "}" SHARED_CONSTANTS(VALUE));
    if (constants == NULL)
        return -1;
    const int failed = PyModule_AddObjectRef(module, "constants", constants);
    Py_DECREF(constants);
    return failed;
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, (void *)fill},
#ifdef Py_GIL_DISABLED
    /* Kernels share no data but constants. */
    {Py_mod_gil, Py_MOD_GIL_NOT_USED},
#endif
    {0, NULL},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_compiled", "Loops of quasiharmonic, compiled.", 0, NULL, slots, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__compiled(void)
{
    return PyModuleDef_Init(&definition);
}
