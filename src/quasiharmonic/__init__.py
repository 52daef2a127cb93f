"""Maps of triangle meshes into the plane with no inverted triangle, certified exactly.

The public names are listed in ``__init__.pyi`` and imported when they are first used, so that ``import quasiharmonic``
is fast.
"""

from importlib import import_module

import lazy_loader

from quasiharmonic.util.outcome import register_renderer

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

register_renderer(lambda: import_module(".ui.display", __name__))
