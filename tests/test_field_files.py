"""Displacement fields in NIfTI and ITK files: order of axes, directions of components, headers, round trips."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.ui.cli import main

NEEDED = "no dependency of the tests: .ci/optional installs it"
sitk = pytest.importorskip("SimpleITK", reason=NEEDED)
nibabel = pytest.importorskip("nibabel", reason=NEEDED)

SPACING, ORIGIN, DIRECTION = (0.8, 1.2), (-20.0, 35.0), (0.8, -0.6, 0.6, 0.8)


def folded(h=24, w=31):
    """A field along the axes of the grid, with folds."""
    y, x = np.mgrid[:h, :w]
    bump = 5 * np.exp(-((x - 15) ** 2 + (y - 10) ** 2) / 10)
    return np.stack([bump + 0.1 * x, 0.3 * bump], axis=-1)


def image_of(field):
    """An image of SimpleITK with an oblique grid; its vectors are along the axes of space."""
    image = sitk.GetImageFromArray(field @ np.reshape(DIRECTION, (2, 2)).T, isVector=True)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(DIRECTION)
    return image


@pytest.mark.slow
@pytest.mark.parametrize("name", ["f.mha", "f.nrrd", "f.nii", "f.nii.gz"])
def test_simpleitk_applies_the_written_field(name, tmp_path):
    source, out = str(tmp_path / name), str(tmp_path / f"out_{name}")
    sitk.WriteImage(image_of(folded()), source)
    read = io.read_field(source)
    # NIfTI stores the direction in single precision.
    np.testing.assert_allclose(read.field, folded(), atol=1e-6)
    np.testing.assert_allclose(read.spacing, SPACING, rtol=1e-7)
    assert main(["field", source, "-o", out]) == 0
    field = io.read_field(out).field
    changed = (field != read.field).any(axis=2)
    assert 0 < changed.sum() < 200
    image, before = sitk.ReadImage(out), sitk.ReadImage(source)
    unchanged = (sitk.GetArrayFromImage(image) == sitk.GetArrayFromImage(before))[~changed]
    assert unchanged.all()
    assert image.GetOrigin() == before.GetOrigin()
    assert image.GetDirection() == before.GetDirection()
    transform = sitk.DisplacementFieldTransform(sitk.Cast(image, sitk.sitkVectorFloat64))
    for column, row in ((10, 20), (15, 10), (17, 9), (30, 0)):
        start = before.TransformIndexToPhysicalPoint((column, row))
        moved = np.array([column, row]) + field[row, column] / SPACING
        expected = before.TransformContinuousIndexToPhysicalPoint(moved.tolist())
        np.testing.assert_allclose(transform.TransformPoint(start), expected, atol=1e-5)


@pytest.mark.parametrize(("intent", "sign"), [(1006, (1, 1)), (1007, (-1, -1)), (0, (-1, -1))])
@pytest.mark.parametrize("components", [2, 3])
def test_intents_of_nifti(intent, sign, components, tmp_path):
    path, field = tmp_path / "f.nii", folded(4, 6)
    data = np.zeros((6, 4, 1, 1, components), dtype=np.float32)
    data[..., 0, 0, :2] = field.transpose(1, 0, 2)
    image = nibabel.Nifti1Image(data, np.diag([2.0, 3.0, 1.0, 1.0]))
    image.header["intent_code"] = intent
    nibabel.save(image, path)
    read = io.read_field(path)
    # The affine of the file, and the displacements of DISPVECT, are RAS; those of VECTOR are LPS.
    np.testing.assert_allclose(read.field, field * sign, rtol=1e-6)
    np.testing.assert_array_equal(read.spacing, (2, 3))
    read.write(tmp_path / "g.nii.gz", 2 * read.field)
    again = nibabel.load(tmp_path / "g.nii.gz")
    np.testing.assert_array_equal(again.get_fdata(), 2 * data.astype(float))
    np.testing.assert_array_equal(again.affine, image.affine)
    assert int(again.header["intent_code"]) == intent


def test_wrong_files_are_rejected(tmp_path):
    path = tmp_path / "f.nii"
    for data, affine, message in (
        (np.zeros((4, 5, 6)), np.eye(4), "has shape"),
        (np.zeros((4, 5, 3, 1, 2)), np.eye(4), "has shape"),
        (np.zeros((4, 5, 3, 2, 3)), np.eye(4), "has shape"),
        (1j * np.ones((4, 5, 2)), np.eye(4), "values of type complex64, but displacements are real"),
        (np.ones((4, 5, 1, 1, 3)), np.eye(4), "out of the plane"),
        (np.zeros((4, 5, 2)), np.eye(4)[[0, 2, 1, 3]], "its plane is not"),
        (np.zeros((4, 5, 2)), np.eye(4) + 0.3 * np.eye(4, k=1), "not perpendicular"),
    ):
        kind = np.complex64 if np.iscomplexobj(data) else np.float32
        nibabel.save(nibabel.Nifti1Image(data.astype(kind), affine), path)
        with pytest.raises(io.MeshFileError, match=message):
            io.read_field(path)
    path.write_bytes(b"no image")
    with pytest.raises(io.MeshFileError, match="is not valid NIfTI"):
        io.read_field(path)
    (tmp_path / "f.mha").write_bytes(b"no image")
    with pytest.raises(io.MeshFileError, match="SimpleITK cannot read it"):
        io.read_field(tmp_path / "f.mha")
    assert main(["field", str(path), "--spacing", "2", "-o", str(tmp_path / "g.nii")]) == 2


def folded_volume(d=5, h=6, w=7):
    """A field on voxels along the axes of the grid, with folds."""
    z, y, x = np.mgrid[:d, :h, :w]
    bump = 2 * np.exp(-((x - 3) ** 2 + (y - 2) ** 2 + (z - 2) ** 2))
    return np.stack([bump + 0.1 * z, 0.3 * bump, -0.2 * bump], axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "reflect"),
    [
        *((name, 1) for name in ("f.mha", "f.nrrd", "f.nii", "f.nii.gz")),
        *((name, -1) for name in ("f.mha", "f.nii")),
        *(pytest.param(name, -1, marks=pytest.mark.nightly) for name in ("f.nrrd", "f.nii.gz")),
    ],
)
def test_simpleitk_applies_the_written_volume(name, reflect, tmp_path):
    source, out = str(tmp_path / name), str(tmp_path / f"out_{name}")
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, reflect]])
    image = sitk.GetImageFromArray(folded_volume() @ turn.T, isVector=True)
    image.SetSpacing((1.0, 2.0, 1.5))
    image.SetOrigin((-20.0, 35.0, 7.0))
    image.SetDirection(turn.ravel().tolist())
    sitk.WriteImage(image, source)
    read = io.read_field(source)
    np.testing.assert_allclose(read.field, folded_volume(), atol=1e-6)
    np.testing.assert_allclose(read.spacing, (1, 2, 1.5), rtol=1e-7)
    assert main(["field", source, "-o", out]) == 0
    field = io.read_field(out).field
    changed = (field != read.field).any(axis=3)
    assert 0 < changed.sum() < 100
    image, before = sitk.ReadImage(out), sitk.ReadImage(source)
    assert (sitk.GetArrayFromImage(image) == sitk.GetArrayFromImage(before))[~changed].all()
    assert image.GetOrigin() == before.GetOrigin()
    assert image.GetDirection() == before.GetDirection()
    transform = sitk.DisplacementFieldTransform(sitk.Cast(image, sitk.sitkVectorFloat64))
    for x, y, z in ((3, 2, 2), (4, 2, 2), (6, 5, 4), (0, 3, 2)):
        start = before.TransformIndexToPhysicalPoint((x, y, z))
        moved = np.array([x, y, z]) + field[z, y, x] / (1.0, 2.0, 1.5)
        expected = before.TransformContinuousIndexToPhysicalPoint(moved.tolist())
        np.testing.assert_allclose(transform.TransformPoint(start), expected, atol=1e-5)


@pytest.mark.parametrize(("intent", "sign"), [(1006, (1, 1, 1)), (1007, (-1, -1, 1))])
@pytest.mark.parametrize("middle", [(), (1,)])
def test_intents_of_nifti_volumes(intent, sign, middle, tmp_path):
    path, field = tmp_path / "f.nii", folded_volume(3, 4, 6)
    data = field.transpose(2, 1, 0, 3).reshape(6, 4, 3, *middle, 3).astype(np.float32)
    image = nibabel.Nifti1Image(data, np.diag([2.0, 3.0, 1.5, 1.0]))
    image.header["intent_code"] = intent
    nibabel.save(image, path)
    read = io.read_field(path)
    np.testing.assert_allclose(read.field, field * sign, rtol=1e-6)
    np.testing.assert_array_equal(read.spacing, (2, 3, 1.5))
    read.write(tmp_path / "g.nii.gz", 2 * read.field)
    again = nibabel.load(tmp_path / "g.nii.gz")
    np.testing.assert_array_equal(again.get_fdata(), 2 * data.astype(float))
