"""Read and write files with VTK, for tests that run it in a separate process."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from quasiharmonic import surfaces


def _vtk():
    """The required modules of VTK, without output."""
    from vtkmodules import vtkCommonCore, vtkCommonDataModel, vtkIOCore, vtkIOLegacy, vtkIOXML

    vtkCommonCore.vtkObject.GlobalWarningDisplayOff()
    modules = (vtkCommonCore, vtkCommonDataModel, vtkIOCore, vtkIOLegacy, vtkIOXML)
    return SimpleNamespace(**{name: value for module in modules for name, value in vars(module).items()})


def _square(vtk, single, polygons):
    """A square with data of every kind: small integers, strings, two fields, several arrays of one shape."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    flat, F = surfaces.grid(6, 6)
    place = vtk.vtkPoints()
    place.SetDataType(vtk.VTK_FLOAT if single else vtk.VTK_DOUBLE)
    for x, y in flat.tolist():
        place.InsertNextPoint(x / 3, y / 3, 2)
    grid = vtk.vtkPolyData() if polygons else vtk.vtkUnstructuredGrid()
    grid.SetPoints(place)
    if polygons:
        cells = vtk.vtkCellArray()
        for corners in F.tolist():
            cells.InsertNextCell(3, corners)
        grid.SetPolys(cells)
    else:
        grid.InsertNextCell(vtk.VTK_LINE, 2, [0, 1])
        for corners in F.tolist():
            grid.InsertNextCell(vtk.VTK_TRIANGLE, 3, corners)

    def add(data, name, values, kind=None):
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True, array_type=kind)
        array.SetName(name)
        data.AddArray(array)

    n, cells = len(flat), grid.GetNumberOfCells()
    points, own, whole = grid.GetPointData(), grid.GetCellData(), grid.GetFieldData()
    add(points, "my T", np.sin(np.arange(n)))
    points.SetActiveScalars("my T")
    add(points, "flag", np.arange(n) % 5, vtk.VTK_CHAR)
    add(points, "count", np.arange(n) - 3, vtk.VTK_SHORT)
    displacement = np.zeros((n, 3))
    upper = flat[:, 1] == 1
    displacement[upper, 1] = -0.1 * np.sin(np.pi * flat[upper, 0]) ** 2
    add(points, "displacement", displacement)
    add(points, "velocity", np.cos(np.arange(3 * n)).reshape(n, 3).astype(np.float32))
    points.SetActiveVectors("velocity")
    add(own, "material", np.arange(cells) % 3, vtk.VTK_UNSIGNED_CHAR)
    add(own, "stress", np.arange(3 * cells).reshape(-1, 3) * 0.5)
    add(own, "id", np.arange(cells), vtk.VTK_ID_TYPE)
    add(whole, "TIME", np.array([0.25]))
    add(whole, "CYCLE", np.array([7]), vtk.VTK_INT)
    names = vtk.vtkStringArray()
    names.SetName("who")
    for name in ("one two", "", "x" * 100):
        names.InsertNextValue(name)
    whole.AddArray(names)
    return grid


def content(path):
    """The content that VTK finds in a file, with positions separate from the rest."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    vtk = _vtk()
    reader = vtk.vtkXMLUnstructuredGridReader() if path.suffix == ".vtu" else vtk.vtkDataSetReader()
    if path.suffix == ".vtk":
        reader.ReadAllScalarsOn()
        reader.ReadAllVectorsOn()
        reader.ReadAllFieldsOn()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutput()
    rest = {"cells": [], "kinds": [grid.GetCellType(i) for i in range(grid.GetNumberOfCells())]}
    for i in range(grid.GetNumberOfCells()):
        ids = grid.GetCell(i).GetPointIds()
        rest["cells"].append([ids.GetId(k) for k in range(ids.GetNumberOfIds())])
    for what in ("Point", "Cell", "Field"):
        data = getattr(grid, f"Get{what}Data")()
        for i in range(data.GetNumberOfArrays()):
            array = data.GetAbstractArray(i)
            values = (
                [array.GetValue(k) for k in range(array.GetNumberOfValues())]
                if isinstance(array, vtk.vtkStringArray)
                else vtk_to_numpy(array).tolist()
            )
            rest[what, array.GetName()] = array.GetDataType(), array.GetNumberOfComponents(), values
    return vtk_to_numpy(grid.GetPoints().GetData()).copy(), rest


def write(
    path,
    *,
    single=False,
    polygons=False,
    version=None,
    binary=False,
    mode=None,
    compressor=None,
    raw=True,
    words=32,
    big=False,
):
    """Write a square in one of VTK's formats."""
    vtk = _vtk()
    if path.suffix == ".vtu":
        writer = vtk.vtkXMLUnstructuredGridWriter()
        getattr(writer, f"SetDataModeTo{mode}")()
        writer.SetCompressor(getattr(vtk, f"vtk{compressor}DataCompressor")() if compressor else None)
        writer.SetEncodeAppendedData(not raw)
        writer.SetHeaderTypeToUInt64() if words == 64 else writer.SetHeaderTypeToUInt32()
        writer.SetByteOrderToBigEndian() if big else writer.SetByteOrderToLittleEndian()
        if compressor:
            writer.SetBlockSize(1000)
    else:
        writer = vtk.vtkDataSetWriter()
        writer.SetFileVersion(version)
        writer.SetFileTypeToBinary() if binary else writer.SetFileTypeToASCII()
    writer.SetFileName(str(path))
    writer.SetInputData(_square(vtk, single, polygons))
    assert writer.Write() == 1
