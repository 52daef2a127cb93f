"""Sequences of maps: certified frames, small motion between them, and frames without a map."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from quasiharmonic import Problem, Status, animate, boundary_loops, certify, io, polish
from quasiharmonic.apps.mesh_motion.motion_smoothing import ProximalPenalty
from quasiharmonic.results import FrameStep
from quasiharmonic.surfaces import cat, disk
from quasiharmonic.ui.cli import main


@pytest.fixture(scope="module")
def head():
    """A cat's head and its boundary loop."""
    V, F = cat(8)
    return V, F, boundary_loops(F, len(V))[0]


def turning_stars(count, frames, depth=0.7):
    """Targets (frames, count, 2) that start and end as a circle, with a turning star in between."""
    angle = 2 * np.pi * np.arange(count) / count
    outlines = []
    for t in np.linspace(0, 1, frames):
        here = angle + 0.18 * np.sin(np.pi * t) * np.cos(3 * angle)
        radius = 1 + depth * np.sin(np.pi * t) ** 2 * np.cos(5 * angle + 2 * np.pi * t)
        outlines.append(np.stack([radius * np.cos(here), radius * np.sin(here)], axis=1))
    return np.array(outlines)


def test_proximal_penalty_against_differences():
    rng = np.random.default_rng(0)
    near = ProximalPenalty(3.0, 0.7)
    away = rng.normal(size=40) + 1j * rng.normal(size=40)
    away[0] = 0
    h = 1e-6
    gradient, (xx, xy, yy) = near.gradient(away), near.blocks(away)
    assert (np.abs(away) < 0.7).any()
    assert (np.abs(away) > 0.7).any()
    for v in range(away.size):
        for step, first, second in ((h, gradient.real, xx + 1j * xy), (1j * h, gradient.imag, xy + 1j * yy)):
            there, back = away.copy(), away.copy()
            there[v] += step
            back[v] -= step
            assert first[v] == pytest.approx((near.value(there) - near.value(back)) / (2 * h), abs=1e-8)
            slope = (near.gradient(there)[v] - near.gradient(back)[v]) / (2 * h)
            assert second[v] == pytest.approx(slope, abs=1e-7)


@pytest.mark.slow
def test_frames_are_certified_and_follow_the_target(head):
    V, F, loop = head
    targets = turning_stars(len(loop), 24)
    animation = animate(Problem(V, F, loop, targets[0]), targets)
    assert animation.found.all()
    assert animation.uv.shape == (24, len(V), 2)
    for uv, target in zip(animation.uv, targets, strict=True):
        assert certify(F, uv).injective
        assert np.array_equal(uv[loop], target)
    assert np.isnan(animation.energies).all()
    assert animation.moves.shape == (23,)


@pytest.mark.slow
@pytest.mark.parametrize(("pinned", "most"), [(False, 2), (True, 5)])
def test_searched_frames_stay_close_to_the_previous_one(pinned, most):
    """If a frame cannot start from the last frame's map, the search stays as close to it as possible."""
    V, F = cat(10 if pinned else 14)
    held = loop = boundary_loops(F, len(V))[0]
    targets = turning_stars(len(loop), 40, depth=0.6 if pinned else 0.75)
    if pinned:
        first = animate(Problem(V, F, loop, targets[0]), targets[:1]).uv[0]
        held = np.append(loop, np.argmin(np.linalg.norm(first, axis=1)))
        targets = np.concatenate([targets, np.zeros((40, 1, 2))], axis=1)
    animation = animate(Problem(V, F, held, targets[0]), targets)
    assert animation.found.all()
    assert any(frame.n_iterations for frame in animation.frames[1:])
    assert animation.largest_move <= most


@pytest.mark.long
def test_polished_frames_do_not_jump(head):
    V, F, loop = head
    targets = turning_stars(len(loop), 16)
    problem = Problem(V, F, loop, targets[0])
    animation = animate(problem, targets, polish="symmetric-dirichlet")
    assert animation.found.all()
    assert animation.largest_move <= 3
    alone = [polish(V, F, uv, fixed=loop).history[-1].energy for uv in animate(problem, targets).uv]
    assert animation.energies.mean() <= 1.1 * np.mean(alone)


@pytest.mark.long
def test_the_sweeps_shorten_jumps(head):
    """The limit on motion cannot be met by the forward sweep alone."""
    V, F, loop = head
    targets = turning_stars(len(loop), 12, depth=0.85)
    problem = Problem(V, F, loop, targets[0])
    swept = []
    tight = animate(
        problem, targets, polish="symmetric-dirichlet", max_motion_ratio=1.2, callback=lambda s: swept.append(s.sweep)
    )
    loose = animate(problem, targets, polish="symmetric-dirichlet", max_motion_ratio=1000)
    assert max(swept) >= 1
    assert tight.largest_move < loose.largest_move
    assert loose.energies.mean() < tight.energies.mean()


@pytest.mark.slow
def test_a_boundary_without_motion(head):
    V, F, loop = head
    targets = turning_stars(len(loop), 8)[[0, 0, 1, 2, 2, 2, 3]]
    animation = animate(Problem(V, F, loop, targets[0]), targets, polish="mips")
    assert np.array_equal(animation.uv[0], animation.uv[1])
    assert np.array_equal(animation.uv[3], animation.uv[5])
    assert np.isnan(animation.moves[[0, 3, 4]]).all()
    assert np.isfinite(animation.moves[[1, 2, 5]]).all()


@pytest.fixture
def backwards(head):
    """Frames, the fifth of which has the opposite orientation."""
    V, F, loop = head
    targets = turning_stars(len(loop), 9, depth=0.4)
    targets[4] = targets[4, ::-1]
    return Problem(V, F, loop, targets[0]), targets


@pytest.mark.slow
@pytest.mark.parametrize("energy", [None, "symmetric-dirichlet"])
def test_an_impossible_frame_is_reported_with_its_reason(backwards, energy):
    problem, targets = backwards
    animation = animate(problem, targets, polish=energy)
    assert np.flatnonzero(~animation.found).tolist() == [4]
    assert animation.frames[4].status is Status.IMPOSSIBLE
    assert animation.frames[4].diagnosis.forbids_injective
    assert "frame 4: " in animation.summary()
    assert animation.to_dict()["missing"] == [4]
    # The search stops as soon as the frame is known to be impossible.
    assert animation.frames[4].n_iterations <= 10
    json.dumps(animation.to_dict(), allow_nan=False)


def test_a_frame_that_crosses_itself_is_reported(head):
    V, F, loop = head
    targets = turning_stars(len(loop), 5, depth=0.4)
    targets[2, :3] = targets[2, [2, 1, 0]]
    animation = animate(Problem(V, F, loop, targets[0]), targets)
    assert np.flatnonzero(~animation.bijective).tolist() == [2]
    assert "frame 2" in animation.summary()


def test_an_impossible_frame_is_interpolated(backwards):
    problem, targets = backwards
    animation = animate(problem, targets, fill_gaps=True)
    assert animation.found.all()
    assert np.flatnonzero(animation.bridged).tolist() == [4]
    assert np.allclose(animation.uv[4][problem.fixed], (targets[3] + targets[5]) / 2)
    assert "between their neighbours: frame 4" in animation.summary()


def test_the_first_frame_has_no_previous_one(backwards):
    problem, targets = backwards
    animation = animate(problem, targets[4:], fill_gaps=True)
    assert np.flatnonzero(~animation.found).tolist() == [0]
    assert not animation.bridged.any()


def test_invalid_targets_are_named(head):
    V, F, loop = head
    targets = list(turning_stars(len(loop), 60))
    problem = Problem(V, F, loop, targets[0])
    targets[57] = targets[57].copy()
    targets[57][[3, 8]] = np.nan
    with pytest.raises(ValueError, match="frame 57 is not finite at rows 3, 8"):
        animate(problem, targets)
    targets[31] = targets[31][1:]
    with pytest.raises(ValueError, match=rf"frame 31 must have shape \({len(loop)}, 2\)"):
        animate(problem, targets)
    with pytest.raises(ValueError, match="no frame"):
        animate(problem, [])
    with pytest.raises(ValueError, match="frame 1 must contain real numbers"):
        animate(problem, [targets[0], targets[1] + 1j])
    for none in (None, 5, "frames"):
        with pytest.raises(TypeError, match="targets must be a sequence of arrays"):
            animate(problem, none)
    with pytest.raises(TypeError, match="animate takes a Problem, not a ndarray"):
        animate(V, targets[:2])


def test_invalid_options_are_reported(head):
    V, F, loop = head
    problem = Problem(V, F, loop, V[loop, :2])
    targets = turning_stars(len(loop), 2)
    for limit in (0.5, np.nan, "3", [3]):
        with pytest.raises(ValueError, match="max_motion_ratio must be a number of at least 1"):
            animate(problem, targets, polish="mips", max_motion_ratio=limit)
    with pytest.raises(ValueError, match="max_motion_ratio applies only to polished frames"):
        animate(problem, targets, max_motion_ratio=2)


@pytest.mark.slow
def test_inputs_are_not_changed(head):
    V, F, loop = head
    targets = turning_stars(len(loop), 4).astype(np.float32)
    before = targets.copy()
    targets.setflags(write=False)
    problem = Problem(V, F, loop, targets[0])
    first, second = (animate(problem, targets, polish="mips", fill_gaps=True) for _ in range(2))
    assert np.array_equal(targets, before)
    assert np.array_equal(first.uv, second.uv)
    assert repr(first) == "<Animation: 4 frames, 4 injective, largest move 1>"


@pytest.mark.parametrize("energy", [None, "mips"])
def test_no_frame_has_a_map(head, energy):
    V, F, loop = head
    targets = turning_stars(len(loop), 3)[:, ::-1]
    animation = animate(Problem(V, F, loop, targets[0]), targets, polish=energy, fill_gaps=True)
    assert not animation.found.any()
    assert animation.largest_move == 0
    assert {frame.status for frame in animation.frames} == {Status.IMPOSSIBLE}


def test_interrupted_before_the_first_frame(head, monkeypatch):
    V, F, loop = head

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("quasiharmonic.apps.mesh_motion.frame_sequence.solve", interrupted)
    targets = turning_stars(len(loop), 3)
    animation = animate(Problem(V, F, loop, targets[0]), targets, polish="mips", fill_gaps=True)
    assert animation.interrupted
    assert animation.frames == []
    assert animation.moves.shape == (0,)
    assert len(animation.uv) == 0
    assert animation.summary().startswith("0 frames")
    json.dumps(animation.to_dict(), allow_nan=False)


@pytest.mark.slow
@pytest.mark.parametrize("sweep", [0, 1])
def test_interrupted_with_the_finished_frames(head, sweep):
    V, F, loop = head
    targets = turning_stars(len(loop), 12, depth=0.85)

    def stop(step: FrameStep) -> None:
        if step.sweep == sweep and step.frame >= 5:
            raise KeyboardInterrupt

    animation = animate(
        Problem(V, F, loop, targets[0]), targets, polish="symmetric-dirichlet", max_motion_ratio=1.2, callback=stop
    )
    assert len(animation.frames) == (6 if sweep == 0 else 12)
    assert animation.found.all()
    assert animation.interrupted
    missing = ("the polish of frames 0, 1, 2, 3, 4, … (6 in all)", "the moves between frames were limited")[sweep]
    assert f"interrupted before {missing}" in animation.summary()
    over = animation.largest_move > 1.2
    assert ("beyond the limit of 1.2" in animation.summary()) == over
    assert over or sweep == 0


def test_one_frame():
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    animation = animate(Problem(V, F, loop, V[loop]), [V[loop]], polish="symmetric-dirichlet")
    assert animation.found.all()
    assert animation.moves.shape == (0,)
    assert animation.largest_move == 0


def run(*arguments):
    return main([str(a) for a in arguments])


@pytest.mark.long
def test_the_command(head, tmp_path, capsys):
    V, F, loop = head
    targets = turning_stars(len(loop), 5)
    animation = animate(Problem(V, F, loop, targets[0]), targets)
    surface = tmp_path / "head.obj"
    io.write_obj(surface, io.MeshData(V, F))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "._f8.obj").write_bytes(b"")
    for t, uv in enumerate(animation.uv):
        io.write_obj(tmp_path / "in" / f"f{t + 8}.obj", io.MeshData(V, F).with_map(uv))
    np.save(tmp_path / "frames.npy", animation.uv)
    out, movie, report = tmp_path / "out", tmp_path / "movie.gif", tmp_path / "report.json"
    assert run("animate", surface, tmp_path / "in", "-o", out, "-o", movie, "--json", report) == 0
    assert "5 frames: 5 with every triangle strictly positive" in capsys.readouterr().out
    written = sorted(out.iterdir())
    assert [path.name for path in written] == [f"{t:04}.obj" for t in range(5)]
    for path, target in zip(written, targets, strict=True):
        again = io.mapped(io.read_mesh(path))
        assert certify(F, again.opened().uv).injective
        assert np.array_equal(again.opened().uv[loop], target)
    from PIL import Image

    with Image.open(movie) as picture:
        assert picture.n_frames == 5
    assert json.loads(report.read_text())["certified"] == 5
    second = tmp_path / "second"
    assert run("animate", surface, tmp_path / "frames.npy", "-o", second, "--polish", "mips") == 0
    assert len(list(second.iterdir())) == 5


def test_errors_of_the_command(head, tmp_path, capsys):
    V, F, loop = head
    surface = tmp_path / "head.obj"
    io.write_obj(surface, io.MeshData(V, F))
    np.save(tmp_path / "short.npy", np.zeros((3, 7, 2)))
    np.save(tmp_path / "none.npy", np.zeros((0, 60, 2)))
    (tmp_path / "no.npy").write_bytes(b"nothing")
    broken = np.ones((4, len(loop), 2))
    broken[2:, 5:7] = np.nan
    np.save(tmp_path / "nan.npy", broken)
    (tmp_path / "empty").mkdir()
    for frames, options, words in (
        ("short.npy", [], "must be real numbers of shape"),
        ("none.npy", [], "must be real numbers of shape"),
        ("no.npy", [], "not an array of numbers"),
        ("nan.npy", [], "nan.npy: frame 2 is not finite at rows 5, 6: give finite numbers"),
        ("missing.npy", [], "missing.npy: there is no such file"),
        ("short.npy", ["-o", tmp_path / "out"], "the same output is given twice"),
        ("short.npy", ["-o", tmp_path / "f.gif", "--frames-per-second", 60], "of a GIF must be at most 50"),
        ("empty", [], "no mesh in this folder"),
        ("short.npy", ["--max-motion-ratio", 2], "--max-motion-ratio needs --polish"),
        ("short.npy", ["--frames-per-second", 2], "needs a moving picture"),
    ):
        assert run("animate", surface, tmp_path / frames, "-o", tmp_path / "out", *options) == 2
        assert words in capsys.readouterr().err
    assert run("animate", surface, tmp_path / "short.npy", "-o", tmp_path / "out.avi") == 2
    assert "give a moving picture" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_unwritable_film_is_reported_before_the_work(head, tmp_path, capsys, monkeypatch):
    V, F, loop = head
    io.write_obj(tmp_path / "head.obj", io.MeshData(V, F))
    (tmp_path / "held.txt").write_text("\n".join(map(str, loop)))
    np.save(tmp_path / "frames.npy", turning_stars(len(loop), 3))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    frames = [tmp_path / "frames.npy", "--fixed", tmp_path / "held.txt"]
    assert run("animate", tmp_path / "head.obj", *frames, "-o", tmp_path / "out", "-o", tmp_path / "film.mp4") == 2
    assert "[video]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_frame_without_a_map_is_not_written(backwards, head, tmp_path, capsys):
    problem, targets = backwards
    V, F, _ = head
    surface = tmp_path / "head.obj"
    io.write_obj(surface, io.MeshData(V, F))
    (tmp_path / "held.txt").write_text("\n".join(map(str, problem.fixed)))
    np.save(tmp_path / "frames.npy", targets)
    frames = [tmp_path / "frames.npy", "--fixed", tmp_path / "held.txt"]
    assert run("animate", surface, *frames, "-o", tmp_path / "out") == 1
    assert "frame 4: " in capsys.readouterr().out
    assert len(list((tmp_path / "out").iterdir())) == len(targets) - 1
    assert run("animate", surface, *frames, "-o", tmp_path / "out", "--fill-gaps") == 0
    assert len(list((tmp_path / "out").iterdir())) == len(targets)
    # A frame left by another run is reported.
    assert "not of this run" not in capsys.readouterr().out
    assert run("animate", surface, *frames, "-o", tmp_path / "out") == 1
    assert "out: 0004.obj" in capsys.readouterr().out


def test_repeated_targets_are_frames_of_the_callback(head):
    V, F, loop = head
    targets = turning_stars(len(loop), 8)[[0, 0, 1, 1]]
    steps = []
    animate(Problem(V, F, loop, targets[0]), targets, callback=steps.append)
    assert [step.frame for step in steps] == [0, 1, 2, 3]
