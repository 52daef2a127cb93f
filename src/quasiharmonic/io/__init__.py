"""Read and write meshes, maps and problems in files.

The package builds on `geometry.mesh`. Start reading in `registry`, which lists the formats, then in
`models.meshdata`: every reader returns its `MeshData`. Each format is a module of `formats` or of `fem`. `accepts_mesh`
has the decorators of functions that accept mesh objects of other libraries, which `objects` converts. The public names
are listed in ``__init__.pyi`` and imported when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
