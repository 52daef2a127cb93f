"""Build of the compiled kernels; all other settings of the package are in pyproject.toml.

Without a compiler, or with ``QUASIHARMONIC_PURE=1``, the package is built without them and uses NumPy alone.
"""

import os
import runpy
import sysconfig
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

PACKAGE = Path(__file__).parent / "src/quasiharmonic"
KERNELS = Path("src/quasiharmonic/util/kernels/c")
# Fused multiply-add would make results differ between machines, so it is disabled.
# The other flags do not change results: errno and floating-point flags are not read, so branches can be avoided.
PRECISE = "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"
FLAGS = {"msvc": ["/std:c11"]}
OTHER_FLAGS = ["-std=c11", "-O3", "-fvisibility=hidden", *PRECISE]
# One wheel serves this Python version and all later ones, except free-threaded builds.
STABLE = not sysconfig.get_config_var("Py_GIL_DISABLED")

# Write the header of the constants that the C files share with the Python source.
runpy.run_path(str(PACKAGE / "util/kernels/constants.py"), run_name="__main__")


class BuildKernels(build_ext):
    """Choose flags by the compiler, which is GCC on Windows too where Python was built with MinGW."""

    def build_extensions(self) -> None:
        kind = self.compiler.compiler_type
        for extension in self.extensions:
            extension.extra_compile_args = FLAGS.get(kind, OTHER_FLAGS)
            extension.libraries = ["m"] if kind == "unix" else []
        super().build_extensions()


if os.environ.get("QUASIHARMONIC_PURE", "0") not in ("", "0"):
    setup()
else:
    setup(
        ext_modules=[
            Extension(
                "quasiharmonic.util.kernels._compiled",
                sorted(str(path) for path in KERNELS.glob("*.c")),
                depends=sorted(str(path) for path in KERNELS.glob("*.h")),
                define_macros=[("Py_LIMITED_API", "0x030B0000")] if STABLE else [],
                py_limited_api=STABLE,
                optional=True,
            )
        ],
        cmdclass={"build_ext": BuildKernels},
        options={"bdist_wheel": {"py_limited_api": "cp311"}} if STABLE else {},
    )
