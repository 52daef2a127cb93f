"""``qhm field``: compute the nearest displacement field of an image without folds, and its inverse.

Make a displacement field invertible with the least change. Away from folds the field is unchanged, bit for bit. A
.npy array has shape (height, width, 2), with displacements along x (to the right) and y (down) in the unit of
--spacing, or (depth, height, width, 3) on a volume. NIfTI files (.nii, .nii.gz) need nibabel, ITK's files (.mha,
.nrrd) need SimpleITK; their vectors are along the axes of space, as ITK, ANTs and elastix write them. On volumes, six
tetrahedra per cell are certified; ITK and ANTs interpolate trilinearly, for which --interpolation trilinear gives a
certificate.

Exit status: 0 the written field is certified without folds; 1 written, but the inverse that --inverse requests does
not exist, because the border overlaps itself; 2 wrong input or call, or no such field was found, nothing written; 3
written, but the report failed.

    qhm field field.npy -o field_without_folds.npy
    qhm field field.npy --inverse inverse.npy -o field_without_folds.npy
    qhm field warp.nii.gz -o warp_without_folds.nii.gz
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import pipeline, report
from quasiharmonic.ui.cli.arguments import add_files, add_options, choice, file, flag, number

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.displacement_fields.grid import FieldStep
    from quasiharmonic.io.fields import DisplacementField
    from quasiharmonic.util.arrays import BoolArray


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_files(parser, ".npy, .nii, .nii.gz, .mha or .nrrd file", "file to write, of the same kind as the input")
    add_options(
        parser,
        inverse=file(
            "also write the inverse of the new field, of the same kind and grid; NaN outside the field's image"
        ),
        spacing=number(
            float,
            "for .npy: distance between pixels, or distances along x, along y, and along z (default: 1)",
            metavar="LENGTH",
            nargs="+",
        ),
        min_jacobian=number(
            float,
            "lower bound of the Jacobian determinants at the corners of pixels, or of the volume ratios of the six "
            "tetrahedra of each cell of a volume (default: 0.01)",
            metavar="DET",
            default=0.01,
        ),
        interpolation=choice(
            ("linear", "trilinear"),
            "for volumes: trilinear also verifies that no cell folds between the voxels if they are interpolated "
            "trilinearly; if one may fold, no file is written (default: linear)",
            default="linear",
        ),
        fix_border=flag("keep the displacements of the border's pixels"),
    )
    add_options(parser, "json")


def run(options: argparse.Namespace) -> int:
    """Read, make invertible, write, report."""
    from quasiharmonic.apps.displacement_fields.field_inversion import inverse_field
    from quasiharmonic.apps.displacement_fields.nearest import InvertibleField, fold_free, nearest_invertible
    from quasiharmonic.io.fields import field_suffix, read_field
    from quasiharmonic.util.outcome import as_plain
    from quasiharmonic.util.progress import report_to

    report.check_new({"-o": options.output, "--inverse": options.inverse}, options.json, inputs=(options.input,))
    outputs = [path for path in (options.output, options.inverse) if path is not None]
    for path in outputs:
        field_suffix(path)
    given = read_field(options.input)
    for path in outputs:
        given.check_output(path)
    field, spacing = given.field, _spacing(options, given)
    with pipeline.show_work(options.input, _words) as show, report_to(show):
        held = _border(field) if options.fix_border else None
        try:
            repaired = nearest_invertible(field, spacing=spacing, min_jacobian=options.min_jacobian, fixed=held)
        except RuntimeError as error:
            raise ValueError(str(error)) from error
    if not repaired.success:
        fixed = (
            "" if held is None or isinstance(repaired, InvertibleField) else _describe_fixed(repaired.remaining, held)
        )
        raise ValueError(f"no field without folds was found. {repaired.summary()}{fixed}")
    if options.interpolation != "linear":
        _check_interpolation(repaired.field, spacing, options.interpolation)
    given.write(options.output, repaired.field)
    invertible = bool(repaired.certificate.bijective)

    def describe() -> pipeline.Account:
        # Rotation to the axes of space rounds, so the file is verified.
        written = read_field(options.output).field
        if not fold_free(written, spacing=spacing, interpolation=options.interpolation).all():
            raise ValueError("rounding has folded the field: give a larger --min-jacobian")
        facts: dict[str, Any] = {
            "injective": repaired.success,
            "bijective": invertible,
            "moved": int(repaired.moved_mask.sum()),
            **as_plain(repaired, "folds", "patches", "distance", "seconds"),
            **pipeline.name_files(options),
        }
        lines = [f"wrote {options.output}: {repaired.summary()}"]
        if options.inverse is not None and invertible:
            back = inverse_field(written, spacing=spacing)
            given.write(options.inverse, back.field)
            lines.append(f"wrote {options.inverse}: {back.summary()}")
            facts["inverse"] = str(options.inverse)
        elif options.inverse is not None:
            lines.append(f"{options.inverse} is not written: the field has no inverse")
        return pipeline.Account(facts, lines, invertible or options.inverse is None)

    return pipeline.finish(options, describe, options.output)


def _words(step: FieldStep) -> str:
    return f"iteration {step.iteration}   patches {step.patches}   free points {step.points}"


def _spacing(options: argparse.Namespace, given: DisplacementField) -> float | list[float]:
    """Return the distance between pixels."""
    if options.input.suffix.lower() != ".npy":
        if options.spacing is not None:
            raise ValueError(f"--spacing is for .npy: {options.input} has its own")
        return [float(length) for length in given.spacing]
    lengths: list[float] = options.spacing or [1.0]
    return lengths if len(lengths) > 1 else lengths[0]


def _check_interpolation(field: NDArray[np.float64], spacing: float | list[float], interpolation: str) -> None:
    """Raise ValueError if a field may fold between its voxels."""
    import numpy as np

    from quasiharmonic.apps.displacement_fields.nearest import fold_free
    from quasiharmonic.util.arrays import count_of

    doubtful = np.argwhere(~fold_free(field, spacing=spacing, interpolation=interpolation))
    if len(doubtful):
        first = ", ".join(str(tuple(cell)) for cell in doubtful[:5].tolist())
        raise ValueError(
            f"{count_of('cell', 'cells', len(doubtful))} may fold with {interpolation} interpolation; the first voxels "
            f"(slice, row, column) of the first ones are {first}: give a larger --min-jacobian"
        )


def _border(field: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the border's pixels."""
    import numpy as np

    border = np.ones(field.shape[:-1], dtype=bool)
    border[(slice(1, -1),) * border.ndim] = False
    return border


def _describe_fixed(remaining: BoolArray, fixed: BoolArray) -> str:
    """Return a sentence on remaining cells (d − 1, h − 1, w − 1) whose eight voxels are all fixed; empty if none."""
    from quasiharmonic.apps.displacement_fields.grid import find_fixed_cells, name_points

    unrepairable = find_fixed_cells(remaining, fixed)
    if not unrepairable.any():
        return ""
    return f" All eight voxels of some of these cells are fixed; the first of each is {name_points(unrepairable)}."
