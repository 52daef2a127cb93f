"""Read and write files with Gmsh, for tests that run it in a separate process."""

from __future__ import annotations

import numpy as np


def _gmsh():
    """Gmsh, initialised without output and without a model."""
    import gmsh

    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.clear()
    return gmsh


def missing():
    """The reason why Gmsh cannot be used, if there is one: it or a library of the system is not installed."""
    try:
        _gmsh()
    except (ImportError, OSError) as error:
        return str(error)
    return None


def content(path):
    """The content that Gmsh finds in a file, with positions separate from the rest."""
    gmsh = _gmsh()
    gmsh.merge(str(path))
    model = gmsh.model
    tags, points, parameters = model.mesh.getNodes()
    order = np.argsort(tags)
    rest = {"nodes": sorted(tags.tolist()), "parameters": parameters.tolist()}
    for dim, tag in model.getEntities():
        kinds, elements, nodes = model.mesh.getElements(dim, tag)
        rest[dim, tag] = (
            kinds.tolist(),
            [e.tolist() for e in elements],
            [n.tolist() for n in nodes],
            model.getPhysicalGroupsForEntity(dim, tag).tolist(),
        )
    for dim, tag in model.getPhysicalGroups():
        rest["group", dim, tag] = (
            model.getPhysicalName(dim, tag),
            model.getEntitiesForPhysicalGroup(dim, tag).tolist(),
        )
    for view in gmsh.view.getTags():
        name = gmsh.view.option.getString(view, "Name")
        for step in range(int(gmsh.view.option.getNumber(view, "NbTimeStep"))):
            kind, which, values, time, components = gmsh.view.getModelData(view, step)
            rest["view", gmsh.view.getIndex(view), name, step] = (
                kind,
                np.asarray(which).tolist(),
                [np.asarray(v).tolist() for v in values],
                time,
                components,
            )
    return points.reshape(-1, 3)[order], rest


def square(path, version, binary, *, groups=True, gaps=False, parametric=False, repeated=False):
    """A square with a curve in two physical groups, and data of nodes over time, of elements and of their corners."""
    gmsh = _gmsh()
    gmsh.model.add("square")
    occ, mesh = gmsh.model.occ, gmsh.model.mesh
    occ.addRectangle(0, 0, 0, 1, 1)
    occ.synchronize()
    if groups:
        gmsh.model.addPhysicalGroup(1, [3], 7, "upper side")
        gmsh.model.addPhysicalGroup(1, [1, 3], 8, "clamped")
        gmsh.model.addPhysicalGroup(2, [1], 9, "steel plate")
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.2)
    gmsh.option.setNumber("Mesh.SaveAll", int(not groups))
    gmsh.option.setNumber("Mesh.SaveParametric", int(parametric))
    mesh.generate(2)
    if gaps:
        tags = mesh.getNodes()[0]
        mesh.renumberNodes(tags, 3 * tags[::-1] + 100)
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", int(binary))
    gmsh.option.setNumber("PostProcessing.SaveMesh", int(repeated))
    gmsh.write(str(path))
    if version == 4.0:
        return  # Gmsh writes views only in its own version of the format.
    tags, points, _ = mesh.getNodes()
    points = points.reshape(-1, 3)
    for step in range(3):
        if step == 0:
            view = gmsh.view.add("displacement")
        up = np.where(points[:, 1] == 1, -0.1 * step * np.sin(np.pi * points[:, 0]) ** 2, 0)
        values = np.stack([0 * up, up, 0 * up], axis=1)
        gmsh.view.addHomogeneousModelData(view, step, "square", "NodeData", tags, values.ravel(), step / 2, 3)
    gmsh.view.write(view, str(path), append=True)
    elements = mesh.getElementsByType(2)[0]
    stress = gmsh.view.add("stress")
    gmsh.view.addModelData(stress, 0, "square", "ElementData", elements, np.sin(elements)[:, None])
    gmsh.view.write(stress, str(path), append=True)
    corners = gmsh.view.add("corner stress")
    data = np.cos(np.arange(3 * len(elements))).reshape(-1, 3)
    gmsh.view.addModelData(corners, 0, "square", "ElementNodeData", elements, data, numComponents=1)
    gmsh.view.write(corners, str(path), append=True)
