"""Options of the operations: names, defaults, checks, and texts of the command line, each declared once.

An operation has one frozen class. The keyword functions and the command line derive their options from its fields, and
the library passes its instances on. This module imports nothing heavy, so that the parser of the command line starts
fast.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from functools import wraps
from importlib import import_module
from numbers import Real
from typing import Any, TypeVar

from quasiharmonic.util.hints import suggest

F = TypeVar("F", bound=Callable[..., Any])
#: A function that raises an error for the name of an option and a wrong value.
Check = Callable[[str, Any], None]

# Names of the values that some options accept; the dictionaries with the values themselves are tested to have these.
#: Energies, and what each preserves.
ENERGY_LABELS = {
    "symmetric-dirichlet": "lengths and angles",
    "mips": "angles",
    "blend": "angles, some area",
    "arap-barrier": "rigid",
}
ENERGIES = tuple(ENERGY_LABELS)
FLATTENED = *ENERGIES, "distances"
HARMONISED = "arap", "arap-unsigned", "area", "springs", *ENERGIES
STRATEGIES = "speed", "paper"
FUNCTIONALS = "neumann", "sobolev", "dirichlet", "poisson", "edge-poisson"
PARAMETERISATIONS = "tanh", "si-log"
#: Default maximum number of iterations of a search.
MAX_ITERATIONS = 2000
REFERENCES = "equilateral", "rest", "corrected"
SYMMETRIES = "auto", "x", "y", "z"
UPS = "x", "y", "z", "-x", "-y", "-z"
INSTANCES = "share", "own"
#: Formats of the maps of a data set, by the suffix of their files.
MAP_FORMATS = "obj", "ply"
#: Largest number of samples along a side of a texel.
MAX_SAMPLES = 16
LINEAR_SOLVERS = "auto", "mkl", "cholmod", "rslab", "qdldl", "superlu"


def option(
    default: Any = MISSING,
    help: str = "",
    *,
    check: Check | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare an option.

    ``check`` raises an error for the name and a wrong value. ``help`` and ``choices`` are for the command line; the
    operation itself rejects unknown names.
    """
    return field(default=default, metadata={"help": help, "check": check, "choices": choices})


def _by(check: str, **limits: Any) -> Check:
    """Return a check by a function of `util.arrays` for a name and a value; it is imported at the first call."""

    def call(name: str, value: Any) -> None:
        getattr(import_module("quasiharmonic.util.arrays"), check)(name, value, **limits)

    return call


def _or_none(check: Check) -> Check:
    """Return a check that also accepts None."""

    def call(name: str, value: Any) -> None:
        if value is not None:
            check(name, value)

    return call


# Checks of options by kind. Longer ones are functions below.
positive, count = _by("check_integer", minimum=1), _by("check_integer", minimum=0)
positive_or_none, tolerance, switch = _or_none(positive), _by("check_non_negative"), _by("check_bool")
mirror_axis = _or_none(_by("check_choice", choices=SYMMETRIES))
direction_or_none = _or_none(_by("check_choice", choices=UPS))
reference_name = _by("check_choice", choices=REFERENCES)


def positive_number(name: str, value: Any) -> None:
    """Check a positive number."""
    from quasiharmonic.util.arrays import check_positive

    check_positive(**{name: value})


seconds = _or_none(positive_number)


def check_welding(name: str, value: Any) -> None:
    """Check which vertices are welded: a boolean or a relative distance."""
    from quasiharmonic.util.arrays import check_weld

    check_weld(value)


def function(name: str, value: Any) -> None:
    """Check a callback or None."""
    from quasiharmonic.util.arrays import check_callback

    check_callback(value)


def motion_ratio(name: str, value: Any) -> None:
    """Check a maximum displacement of vertices relative to that of the boundary, or None."""
    if value is not None and (not isinstance(value, Real) or not float(value) >= 1):
        raise ValueError(f"{name} must be a number of at least 1, not {value!r}: the boundary itself has ratio 1")


def sample_count(name: str, value: Any) -> None:
    """Check the number of samples along a side of a texel."""
    positive(name, value)
    if value > MAX_SAMPLES:
        raise ValueError(f"{name} must be at most {MAX_SAMPLES}, not {value}: more would take too much memory")


def stretch_bound(name: str, value: Any) -> None:
    """Check a bound on the stretch."""
    if not isinstance(value, Real) or isinstance(value, bool) or not 1 <= float(value) < float("inf"):
        raise ValueError(f"{name} must be a finite number of at least 1, not {value!r}")


def hard_edges(name: str, value: Any) -> None:
    """Check an angle between two normals in degrees, a list of edges, ``"file"``, or None."""
    from quasiharmonic.util.arrays import describe

    if value is None or (value == "file" if isinstance(value, str) else hasattr(value, "__len__")):
        return
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < float(value) <= 180:
        said = repr(value) if isinstance(value, Real | str) else describe(value)
        raise ValueError(f"{name} must be an angle in degrees, above 0 and at most 180, edges or 'file', not {said}")


def share(name: str, value: Any) -> None:
    """Check a number from 0 to 1."""
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 <= float(value) <= 1:
        raise ValueError(f"{name} must be a number from 0 to 1, not {value!r}")


def texture_size(name: str, value: Any) -> None:
    """Check the side of a texture in texels, or its width and height: at most 8192."""
    from quasiharmonic.util.arrays import check_integer

    sides = tuple(value) if isinstance(value, tuple | list) else (value, value)
    for side in sides:
        check_integer(name, side, minimum=1)
    if len(sides) != 2 or max(sides) > 8192:
        raise ValueError(f"{name} must be a number of texels, or width and height, at most 8192, not {value!r}")


def check_stacking(name: str, value: Any) -> None:
    """Check which charts are stacked: a boolean or ``"mirrored"``."""
    if not isinstance(value, bool) and value != "mirrored":
        raise ValueError(f"{name} must be True, False or 'mirrored', not {value!r}")


def check_instances(name: str, value: Any) -> None:
    """Check what instances of a mesh do; one mesh has none."""
    if value != "share":
        raise ValueError(f"{name}={value!r} needs several meshes: pass a list of meshes, or a scene")


def no_weights(name: str, value: Any) -> None:
    """Check that one mesh has no weight."""
    if value is not None:
        raise ValueError(f"{name} needs several meshes: pass a list of meshes, or a scene")


@dataclass(frozen=True, kw_only=True, eq=False)
class Options:
    """Base of the options of an operation; an instance has checked its values.

    Classes with arrays need ``eq=False``; two instances are then equal only if they are the same.

    Raises
    ------
    ValueError, TypeError
        If a value is invalid.
    """

    def __post_init__(self) -> None:
        for one in fields(self):
            check = one.metadata.get("check")
            if check is not None:
                check(one.name, getattr(self, one.name))


def takes(options: type[Options], keywords: type) -> Callable[[F], F]:
    """Decorate a function of ``**options: Unpack[keywords]``, so that its signature shows names, types and defaults.

    ``keywords`` is a TypedDict with the types of the fields of ``options`` that the function has.
    """
    defaults = {one.name: one.default for one in fields(options)}
    shown = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=getattr(of, "__forward_arg__", of)
        )
        for name, of in keywords.__annotations__.items()
    ]

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        own = [one for one in signature.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        known = {one.name for one in [*own, *shown]}
        # Users call a class, not its method.
        called = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]

        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            for name in given:
                if name not in known:
                    raise TypeError(f"{called}() got an unexpected keyword argument {name!r}{suggest(name, known)}")
            return function(*args, **given)

        call.__signature__ = signature.replace(parameters=[*own, *shown])  # type: ignore[attr-defined]
        return call  # type: ignore[return-value]

    return decorate


@dataclass(frozen=True, kw_only=True, eq=False)
class SolverOptions(Options):
    """Options of every operation that solves linear systems step by step."""

    linear_solver: str = option("auto", "linear solver (default: the fastest one installed)", choices=LINEAR_SOLVERS)
    callback: Callable[[Any], object] | None = option(None, check=function)


_TIME_LIMIT = "end the computation of each island after this many seconds, and keep the best map"


@dataclass(frozen=True, kw_only=True, eq=False)
class MapOptions(SolverOptions):
    """Options of `quasiharmonic.injective_map` and `quasiharmonic.solve`."""

    strategy: Any = option(
        "speed",
        "the fastest method, or the paper's pipeline, which starts with si-log (default: speed)",
        choices=STRATEGIES,
    )
    polish: Any = option(None)
    start: Any = option(None)
    max_iterations: int = option(MAX_ITERATIONS, "maximum number of linear solves (default: 2000)", check=positive)
    record_every: int = option(0, check=count)
    time_limit: float | None = option(None, _TIME_LIMIT, check=seconds)
    slide: Any = option(False)
    refine: bool = option(
        False, "if no map is found soon, split as few inner edges as necessary (adds vertices at the end)", check=switch
    )


def one_of(*words: str | None) -> Check:
    """Return a check of an option with one of several words."""

    def check(name: str, value: Any) -> None:
        if not isinstance(value, str | None) or value not in words:
            raise ValueError(
                f"{name} must be one of {', '.join(map(str, words))}, not {value!r}"
                f"{suggest(value, [word for word in words if word])}"
            )

    return check


@dataclass(frozen=True, kw_only=True)
class DescentOptions(Options):
    """Options of `quasiharmonic.methods.VectorAdam` as the only stage of a search; all None: a strategy."""

    functional: str | None = option(
        None,
        "in place of a strategy: descend only this functional of the tensors (default: dirichlet)",
        check=one_of(None, *FUNCTIONALS),
        choices=FUNCTIONALS,
    )
    parameterisation: str | None = option(
        None,
        "in place of a strategy: parameterisation of the tensors in the descent (default: tanh)",
        check=one_of(None, *PARAMETERISATIONS),
        choices=PARAMETERISATIONS,
    )
    iterations: int | None = option(
        None,
        "in place of a strategy: maximum number of iterations of the descent (default: 1000)",
        check=positive_or_none,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PolishOptions(SolverOptions):
    """Options of `quasiharmonic.polish`."""

    energy: Any = option("symmetric-dirichlet", "energy to lower (default: symmetric-dirichlet)", choices=ENERGIES)
    weights: Any = option(None)
    max_iterations: int = option(200, "maximum number of Newton steps (default: 200)", check=count)
    tol: float = option(1e-4, check=tolerance)
    record_every: int = option(0, check=count)
    time_limit: float | None = option(None, _TIME_LIMIT, check=seconds)
    slide: Any = option(False)


@dataclass(frozen=True, kw_only=True, eq=False)
class HarmoniseOptions(SolverOptions):
    """Options of `quasiharmonic.harmonise`."""

    energy: Any = option("arap", "energy to lower (default: arap)", choices=HARMONISED)
    eta: Any = option(None)
    conformal: float = option(1e-3, check=tolerance)
    weights: Any = option(None)
    scaled: bool = option(True, check=switch)
    max_iterations: int = option(40, "maximum number of linear solves per round (default: 40)", check=positive)
    tol: float = option(1e-3, check=tolerance)
    reference: str = option("rest", check=reference_name)


@dataclass(frozen=True, kw_only=True, eq=False)
class DistanceOptions(SolverOptions):
    """Options of `quasiharmonic.keep_distances`."""

    rings: int = option(20, check=positive)
    max_iterations: int = option(100, check=count)
    tol: float = option(1e-3, check=tolerance)
    record_every: int = option(0, check=count)


@dataclass(frozen=True, kw_only=True, eq=False)
class FlattenOptions(DistanceOptions):
    """Options of `quasiharmonic.flatten`."""

    energy: Any = option(
        "symmetric-dirichlet",
        "energy to lower; mips preserves only angles, distances preserves distances between nearby vertices "
        "(default: symmetric-dirichlet)",
        choices=FLATTENED,
    )
    max_iterations: int = option(
        500, "maximum steps on each connected surface; 0 keeps the start (default: 500)", check=count
    )
    tol: float = option(1e-4, check=tolerance)
    fixed: Any = option(None)
    target: Any = option(None)
    weights: Any = option(None)
    start: Any = option(None)
    time_limit: float | None = option(None, _TIME_LIMIT, check=seconds)
    unit_square: bool = option(False, "scale the map evenly into the unit square", check=switch)
    gap: float = option(0.0, check=tolerance)
    weld: Any = option(False, check=check_welding)

    @property
    def energy_name(self) -> str:
        """Name of the energy, for reports."""
        return self.energy if isinstance(self.energy, str) else type(self.energy).__name__


@dataclass(frozen=True, kw_only=True, eq=False)
class TetrahedraOptions(Options):
    """Options of `quasiharmonic.injective_tetrahedra`."""

    start: Any = option(None)
    polish: bool = option(True, check=switch)
    max_iterations: int = option(1000, check=count)
    tol: float = option(1e-6, check=positive_number)
    callback: Callable[[Any], object] | None = option(None, check=function)


@dataclass(frozen=True, kw_only=True, eq=False)
class MorphOptions(SolverOptions):
    """Options of `quasiharmonic.morph`; its two kinds of mesh check ``max_iterations`` and ``tol``."""

    energy: Any = option("symmetric-dirichlet", choices=ENERGIES)
    max_iterations: int = option(MAX_ITERATIONS)
    slide: Any = option(False)
    rest: Any = option(None)
    start: Any = option(None)
    tol: float = option(1e-8)


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingOptions(Options):
    """Options of `quasiharmonic.MovingMesh`; a sliding boundary in the plane needs ``settle`` of at least 1."""

    energy: Any = option("blend", choices=ENERGIES)
    settle: int = option(1, check=count)
    slide: Any = option(False)
    linear_solver: str = option("auto", choices=LINEAR_SOLVERS)


@dataclass(frozen=True, kw_only=True, eq=False)
class RepairOptions(SolverOptions):
    """Options of `quasiharmonic.repair`."""

    fixed: Any = option(None)
    whole: bool = option(False, check=switch)
    unmirror: bool = option(False, check=switch)
    max_iterations: int = option(MAX_ITERATIONS, check=positive)


@dataclass(frozen=True, kw_only=True, eq=False)
class AnimationOptions(SolverOptions):
    """Options of `quasiharmonic.animate`."""

    polish: Any = option(None, choices=ENERGIES)
    max_motion_ratio: float | None = option(None, check=motion_ratio)
    fill_gaps: bool = option(False, check=switch)
    start: Any = option(None)
    max_iterations: int = option(MAX_ITERATIONS, check=positive)


@dataclass(frozen=True, kw_only=True, eq=False)
class BakeOptions(Options):
    """Options of `quasiharmonic.bake`."""

    size: Any = option(2048, check=texture_size)
    samples: int = option(
        1, "samples along each side of a texel, which gets their mean, 1 to 16 (default: 1)", check=sample_count
    )
    padding: int = option(
        16, "texels around each chart that get the value of the nearest texel of a chart (default: 16)", check=count
    )
    max_distance: float = option(
        0.05,
        "maximum distance between both models, relative to the diagonal of the bounding box of the new one (default: "
        "0.05)",
        check=tolerance,
    )
    jpeg: bool = option(False, "write colours without opacity as JPEG (default: PNG)", check=switch)


@dataclass(frozen=True, kw_only=True, eq=False)
class UnwrapOptions(Options):
    """Options of `quasiharmonic.unwrap`."""

    max_stretch: float = option(
        1.5,
        "bound on the stretch at 99 %% of the surface; smaller values need more seams (default: 1.5)",
        check=stretch_bound,
    )
    max_charts: int | None = option(None, "maximum number of charts (default: no limit)", check=positive_or_none)
    hard_edges: Any = option(None, check=hard_edges)
    symmetry: str | None = option(
        "auto",
        "mirror seams and charts in the middle plane normal to an axis (default: auto, where the model is symmetric)",
        check=mirror_axis,
        choices=(*SYMMETRIES, "none"),
    )
    up: str | None = option(
        None,
        "axis that points up, as in --up z or --up=-z: seams cost less on downward faces and in concave edges "
        "(default: none)",
        check=direction_or_none,
        choices=UPS,
    )
    packing_loss: float = option(
        0.02,
        "share of the texture that may be lost when flat and developable parts are joined (default: 0.02)",
        check=share,
    )
    divide_for_packing: bool = option(
        False, "also divide flat and developable parts where this saves texture", check=switch
    )
    straighten: bool = option(
        False, "make strips of quadrilaterals rectangles, as far as the bound on the stretch permits", check=switch
    )
    resolution: Any = option(2048)
    padding: float = option(4.0, "minimum texels between two charts (default: 4)")
    texels_per_unit: float | None = option(None, "texels per unit of length of the model (default: as many as fit)")
    tiles: int = option(1, "number of UDIM tiles (default: 1)", check=positive)
    tile_by: Any = option(None)
    lightmap: bool = option(
        False,
        "make texture coordinates for a lightmap: charts on whole texels, so that filters do not mix them, and places "
        "of their own for instances",
        check=switch,
    )
    rotate: bool = option(True)
    stack: Any = option(False, check=check_stacking)
    outward: bool = option(False, "treat closed components that are inside out as turned outward", check=switch)
    weld: Any = option(True, check=check_welding)
    meshes: Any = option(None)
    instances: str = option("share", check=check_instances)
    weights: Any = option(None, check=no_weights)
    edge_costs: Any = option(None)
    seams: Any = option(None)
    no_seams: Any = option(None)
    labels: Any = option(None)
    uv: Any = option(None)
    faces: Any = option(None)
    seed: int = option(0, "seed of random choices (default: 0)", check=count)
    time_limit: float | None = option(
        None, "end the search for few charts after this many seconds, and keep the best charts", check=seconds
    )
    callback: Callable[[Any], object] | None = option(None, check=function)
    jobs: int | None = option(
        None, "number of threads from 200,000 triangles on (default: all cores)", check=positive_or_none
    )
