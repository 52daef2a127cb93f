"""Options of the operations: one class each, which checks its values and gives the functions their signatures."""

from __future__ import annotations

import argparse
import inspect
import subprocess
import sys
from dataclasses import FrozenInstanceError, dataclass, fields
from typing import ClassVar, TypedDict, Unpack

import numpy as np
import pytest

import quasiharmonic
from quasiharmonic import flatten, harmonise, injective_map, injective_maps, keep_distances, morph, polish, solve
from quasiharmonic.apps.gradients.layers import SolvedOptions
from quasiharmonic.energies import polishing
from quasiharmonic.linsolve import BACKENDS
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS
from quasiharmonic.solver.search import harmonising, stages
from quasiharmonic.ui.cli.arguments import add_options, byte_count, declare_options
from quasiharmonic.util import options
from quasiharmonic.util.arrays import check_non_negative, check_weld
from quasiharmonic.util.options import (
    AnimationOptions,
    DistanceOptions,
    FlattenOptions,
    HarmoniseOptions,
    MapOptions,
    MorphOptions,
    MovingOptions,
    Options,
    PolishOptions,
    RepairOptions,
    TetrahedraOptions,
    option,
    positive,
    takes,
)

FUNCTIONS = [
    (injective_map, MapOptions),
    (solve, MapOptions),
    (injective_maps, MapOptions),
    (polish, PolishOptions),
    (harmonise, HarmoniseOptions),
    (flatten, FlattenOptions),
    (keep_distances, DistanceOptions),
    (morph, MorphOptions),
    (quasiharmonic.injective_tetrahedra, TetrahedraOptions),
]


@pytest.mark.parametrize(("function", "of"), FUNCTIONS, ids=lambda one: one.__name__)
def test_signatures_show_every_option_with_its_default(function, of):
    parameters = inspect.signature(function).parameters
    shown = {one.name: parameters[one.name].default for one in fields(of) if one.name in parameters}
    assert shown
    assert shown.items() <= {one.name: one.default for one in fields(of)}.items() | {("callback", None)}
    if function is not injective_maps:
        assert len(shown) == len(fields(of))
    assert not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    assert all(parameters[name].annotation is not parameters[name].empty for name in shown)


@pytest.mark.parametrize(("function", "of"), FUNCTIONS, ids=lambda one: one.__name__)
def test_docstrings_describe_every_option(function, of):
    names = [one.name for one in fields(of) if one.name in inspect.signature(function).parameters]
    assert [name for name in names if name not in function.__doc__] == []


@pytest.mark.parametrize(("function", "of"), FUNCTIONS, ids=lambda one: one.__name__)
def test_an_unknown_option_is_an_error(function, of):
    with pytest.raises(TypeError, match=rf"{function.__name__}\(\) got an unexpected keyword argument 'polsh'"):
        function([], [], [], [], polsh=1) if function not in (solve, injective_maps) else function([], polsh=1)


@pytest.mark.parametrize(
    ("of", "wrong"),
    [
        (MapOptions, {"max_iterations": 0}),
        (MapOptions, {"max_iterations": 1.5}),
        (MapOptions, {"max_iterations": True}),
        (MapOptions, {"record_every": True}),
        (MapOptions, {"record_every": -1}),
        (MapOptions, {"refine": "yes"}),
        (MapOptions, {"callback": 3}),
        (PolishOptions, {"tol": -1.0}),
        (PolishOptions, {"max_iterations": -1}),
        (HarmoniseOptions, {"reference": "other"}),
        (HarmoniseOptions, {"conformal": float("nan")}),
        (DistanceOptions, {"rings": 0}),
        (FlattenOptions, {"gap": -0.5}),
        (FlattenOptions, {"unit_square": 2}),
        (TetrahedraOptions, {"tol": 0.0}),
    ],
)
def test_a_wrong_value_is_an_error_that_names_the_option(of, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        of(**wrong)


@pytest.mark.parametrize(
    ("of", "arrays"),
    [
        (MapOptions, ("start",)),
        (PolishOptions, ("weights",)),
        (HarmoniseOptions, ("weights", "eta")),
        (FlattenOptions, ("fixed", "target", "weights", "start")),
        (TetrahedraOptions, ("start",)),
        (MorphOptions, ("rest", "start", "slide")),
        (RepairOptions, ("fixed",)),
        (AnimationOptions, ("start",)),
        (MovingOptions, ("slide",)),
        (SolvedOptions, ("start",)),
    ],
)
def test_options_with_arrays_are_compared_and_hashed(of, arrays):
    one, other = (of(**{name: np.ones(3) for name in arrays}) for _ in range(2))
    assert one == one
    assert one != other
    assert len({one, one, other}) == 2


def test_an_unknown_option_of_a_class_names_the_class():
    with pytest.raises(TypeError, match=r"^MovingMesh\(\) got an unexpected keyword argument 'setle'"):
        quasiharmonic.MovingMesh([], [], [], setle=1)


def test_options_are_frozen():
    with pytest.raises(FrozenInstanceError):
        MapOptions().refine = True


def test_names_are_those_of_the_values():
    """The lists of names stand apart from the values, so that the command line does not import them."""
    assert tuple(polishing.ENERGIES) == options.ENERGIES
    assert set(options.HARMONISED) == set(harmonising.ENERGIES)
    assert tuple(stages.STRATEGIES) == options.STRATEGIES
    assert tuple(FUNCTIONALS) == options.FUNCTIONALS
    assert tuple(PARAMETERISATIONS) == options.PARAMETERISATIONS
    assert set(options.LINEAR_SOLVERS) == {"auto", *BACKENDS}


def test_a_new_option_needs_a_field_and_a_type():
    class Keywords(TypedDict, total=False):
        depth: int

    class Depth(Options):
        pass

    @dataclass(frozen=True, kw_only=True)
    class Dive(Depth):
        depth: int = option(3, check=positive)

    @takes(Dive, Keywords)
    def dive(place: str, **given: Unpack[Keywords]) -> int:
        return Dive(**given).depth

    assert dive("sea") == 3
    assert dive("sea", depth=7) == 7
    assert str(inspect.signature(dive)).startswith("(place: 'str', *, depth: 'int' = 3)")
    with pytest.raises(ValueError, match="depth"):
        dive("sea", depth=0)


def test_numbers_of_the_command_line_have_the_type_of_their_field():
    @dataclass(frozen=True, kw_only=True)
    class Dive(Options):
        depth: int = option(3, "how deep", check=positive)
        stops: int = option(0, "how many", check=options.count)
        divers: int | None = option(None, "how many", check=lambda name, value: None)
        speed: float | None = option(None, "how fast", check=options.seconds)

    parser = argparse.ArgumentParser(exit_on_error=False)
    add_options(parser, **declare_options(Dive))
    given = parser.parse_args(["--depth", "2", "--stops", "0", "--divers", "4", "--speed", "5"])
    assert [type(value) for value in vars(given).values()] == [int, int, int, float]
    assert parser.parse_args([]).divers is None
    for wrong, message in (
        (("--depth", "0"), "0 is not an integer of at least 1"),
        (("--depth", "x"), "x is not an integer of at least 1"),
        (("--stops", "1.5"), "1.5 is not an integer of at least 0"),
        (("--divers", "1.5"), "invalid int value: '1.5'"),
    ):
        with pytest.raises(argparse.ArgumentError, match=f"{message}$"):
            parser.parse_args(wrong)


def test_the_options_import_nothing_heavy():
    code = "import sys, quasiharmonic.util.options; print({'numpy', 'scipy'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


def test_unsupported_types_have_no_option_on_the_command_line():
    @dataclass(frozen=True)
    class Named(Options):
        shared: ClassVar[int] = 1
        name: str = option("a", "a name")

    with pytest.raises(TypeError, match="no option of type str: name"):
        declare_options(Named)


def test_sizes_beyond_the_range_of_floats_are_rejected():
    with pytest.raises(argparse.ArgumentTypeError, match="not a size"):
        byte_count("9" * 400)


def test_numbers_beyond_the_range_of_floats_are_rejected():
    with pytest.raises(ValueError, match="weld must be"):
        check_weld(10**400)
    with pytest.raises(ValueError, match="tol must be"):
        check_non_negative("tol", 10**400)
