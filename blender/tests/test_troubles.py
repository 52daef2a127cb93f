"""What cannot be done is said in a report, and whatever is cancelled or refused leaves everything as it was."""

import importlib
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
import scenes

ALL = ["check", "repair", "unwrap", "flatten", "reduce_stretch", "fit"]


def refused(act, **rest):
    """The report of an operator that refuses; it is no traceback."""
    with pytest.raises(RuntimeError) as error:
        getattr(bpy.ops.uv, f"qhm_{act}")(**rest)
    text = str(error.value)
    assert text.startswith("Error: ")
    assert "Traceback" not in text
    assert len(text.strip().splitlines()) == 1
    return text


@pytest.mark.parametrize("act", ["check", "repair", "reduce_stretch"])
def test_without_uvs(act):
    thing = scenes.add_mesh(*scenes.quads()[::2])
    assert "has no UV map" in refused(act)
    assert len(thing.data.uv_layers) == 0


@pytest.mark.parametrize("act", ALL)
@pytest.mark.parametrize("edit", [False, True])
def test_without_faces(act, edit):
    scenes.add_mesh([[0, 0, 0]], [])
    bpy.ops.object.mode_set(mode="EDIT" if edit else "OBJECT")
    assert "has no faces" in refused(act)
    assert bpy.context.mode == ("EDIT_MESH" if edit else "OBJECT")


@pytest.mark.parametrize("act", ALL)
def test_without_a_mesh(act):
    bpy.ops.object.empty_add()
    assert not getattr(bpy.ops.uv, f"qhm_{act}").poll()


@pytest.fixture
def linked(tmp_path):
    """A selected, active object of another file."""
    thing = scenes.add_quads()
    thing.name = "linked"
    bpy.data.libraries.write(str(tmp_path / "other.blend"), {thing})
    bpy.data.objects.remove(thing)
    with bpy.data.libraries.load(str(tmp_path / "other.blend"), link=True) as (there, here):
        here.objects = there.objects
    (thing,) = here.objects
    bpy.context.collection.objects.link(thing)
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing
    yield thing
    bpy.data.libraries.remove(thing.data.library)


@pytest.mark.parametrize("act", ALL)
def test_linked_from_another_file(act, linked):
    before = scenes.places(linked)
    assert "linked from another file" in refused(act)
    assert np.array_equal(scenes.places(linked), before)


@pytest.mark.parametrize("act", ALL)
def test_selected_objects_of_another_file_are_left_out_and_reported(act, linked, said):
    before = scenes.places(linked)
    scenes.add_quads()
    linked.select_set(True)
    assert getattr(bpy.ops.uv, f"qhm_{act}")() == {"FINISHED"}
    assert "linked from another file, so left unchanged: linked" in said()
    assert np.array_equal(scenes.places(linked), before)


def test_repair_reports_the_verdict_before_the_reasons(said):
    thing = scenes.add_quads()
    scenes.set_places(thing, 0 * scenes.places(thing))
    assert bpy.ops.uv.qhm_repair() == {"FINISHED"}
    (line,) = (line for line in said().splitlines() if "Repair UVs" in line)
    assert line.startswith("Warning: Repair UVs: 1 island: 0 injective, 0 bijective. Island at triangle 0")
    assert "No injective map exists" in line


@pytest.mark.parametrize("act", ["flatten", "reduce_stretch"])
def test_advice_names_operators_of_blender(act):
    V, flat, faces = scenes.quads(4)
    narrow, turned = V.copy(), faces.copy()
    narrow[7], turned[5] = V[6], faces[5, ::-1]
    scenes.add_mesh(narrow, faces, flat)
    assert "Degenerate Dissolve, or use Unwrap Model" in refused(act)
    scenes.add_mesh(V, turned, flat)
    assert "Recalculate Outside, or use Unwrap Model" in refused(act)


def test_replaced_advice_is_that_of_the_package(extension):
    import quasiharmonic
    from quasiharmonic.results import Kind

    advice = importlib.import_module(f"{extension}.advice").ADVICE
    sources = [path.read_text(encoding="utf-8") for path in Path(quasiharmonic.__file__).parent.rglob("*.py")]
    sources.append(Kind.REVERSED.value)
    assert not [said for said in advice if not any(said in text for text in sources)]


def test_unwrap_of_an_object_whose_scale_is_no_number():
    scenes.add_quads().scale = (float("nan"), 1, 1)
    bpy.context.view_layer.update()
    assert "scale or rotation of thing is not finite" in refused("unwrap")


@pytest.mark.parametrize("act", ["flatten", "fit"])
def test_closed_without_seams(act):
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, calc_uvs=False)
    assert "Cut and Flatten" in refused(act)
    assert len(bpy.context.active_object.data.uv_layers) == 0


def test_three_faces_at_an_edge():
    V = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]
    scenes.add_mesh(V, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert "0, 1" in refused("flatten")


def test_reduce_stretch_of_flipped_faces_says_what_to_do():
    thing = scenes.add_quads()
    scenes.move_vertex(thing, 24, [0.1, 0.1])
    before = scenes.places(thing)
    assert "not injective" in refused("reduce_stretch")
    assert np.array_equal(scenes.places(thing), before)


def test_fit_of_several_islands():
    bpy.ops.mesh.primitive_monkey_add()
    assert "select faces of the one to fit only" in refused("fit")


def test_fit_to_what_is_no_outline():
    bpy.ops.object.empty_add()
    empty = bpy.context.active_object.name
    line = bpy.data.curves.new("line", "CURVE")
    spline = line.splines.new("POLY")
    spline.points.add(2)
    for point, co in zip(spline.points, ([0, 0, 0, 1], [1, 0, 0, 1], [1, 1, 0, 1]), strict=True):
        point.co = co
    bpy.context.collection.objects.link(bpy.data.objects.new("line", line))
    thing = scenes.add_quads()
    before, things = scenes.places(thing), set(bpy.data.objects)
    assert "no object 'nothing'" in refused("fit", to="CURVE", curve="nothing")
    assert "no outline" in refused("fit", to="CURVE", curve=empty)
    assert "no closed outline" in refused("fit", to="CURVE", curve="line")
    assert "name a letter" in refused("fit", to="LETTER", letter=" ")
    assert "only one" in refused("fit", to="LETTER", letter="éß")
    for letter in ("k", "é"):
        assert f"{letter!r} is in 2 separate pieces" in refused("fit", to="LETTER", letter=letter)
    assert "choose another letter" in refused("fit", to="LETTER", letter="€")
    assert np.array_equal(scenes.places(thing), before)
    assert set(bpy.data.objects) == things


@pytest.mark.parametrize("act", ["repair", "unwrap", "flatten", "reduce_stretch", "fit"])
@pytest.mark.parametrize("edit", [False, True])
def test_cancelled_it_leaves_everything_as_it_was(extension, act, edit, monkeypatch, said):
    job = importlib.import_module(f"{extension}.job")
    start = job.Job.start

    def stop_and_start(self):
        self.stop()
        start(self)

    monkeypatch.setattr(job.Job, "start", stop_and_start)
    thing = scenes.adorn(scenes.add_quads())
    if act == "repair":
        scenes.move_vertex(thing, 24, [0.1, 0.1])
    before, kept = scenes.places(thing), scenes.everything_else(thing)
    bpy.ops.object.mode_set(mode="EDIT" if edit else "OBJECT")
    assert getattr(bpy.ops.uv, f"qhm_{act}")() == {"CANCELLED"}
    assert "nothing has changed" in said()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert np.array_equal(scenes.places(thing), before)
    assert scenes.everything_else(thing) == kept


def test_a_job_ends_at_its_next_step(extension):
    job = importlib.import_module(f"{extension}.job")
    told, go_on = threading.Event(), threading.Event()

    def work(reports_progress):
        while True:
            reports_progress(SimpleNamespace(energy=1.0))
            told.set()
            go_on.wait(10)

    one = job.Job(work)
    one.start()
    assert told.wait(10)
    assert one.running
    assert one.steps >= 1
    one.stop()
    go_on.set()
    one.wait()
    assert isinstance(one.error, KeyboardInterrupt)
    assert one.result is None


class Looking:
    """An operator at work in a window, in the place of which a background Blender has none."""

    def __init__(self, job, work):
        self.job, self.log = job, []
        self.bl_label, self._timer = "Work", "timer"
        self.header = SimpleNamespace(layout=SimpleNamespace(progress=lambda **shown: self.log.append(shown)))
        self._job = job.Job(work)
        manager = SimpleNamespace(
            progress_update=lambda count: self.log.append("progress"),
            progress_end=lambda: self.log.append("end"),
            event_timer_remove=self.log.append,
        )
        self.context = SimpleNamespace(
            window_manager=manager,
            workspace=SimpleNamespace(status_text_set=self.draw_status),
            active_object=SimpleNamespace(mode="OBJECT"),
            objects_in_mode=[],
        )

    def __getattr__(self, name):
        return getattr(self.job.Working, name).__get__(self)

    def draw_status(self, draw):
        if draw is None:
            self.log.append(None)
        else:
            draw(self.header, self.context)

    def report(self, kind, text):
        self.log.append(text)

    def finish(self, context, result):
        self.log.append(result)

    def event(self, kind):
        return self.modal(self.context, SimpleNamespace(type=kind, value="PRESS"))


def test_progress_of_an_unwrap_is_a_bar(extension):
    job = importlib.import_module(f"{extension}.job")
    go_on = threading.Event()

    def work(reports_progress):
        reports_progress(SimpleNamespace(phase="flatten", done=3, total=12))
        go_on.wait(10)

    window = Looking(job, work)
    window._job.start()
    while window._job.step is None:
        window._job._thread.join(0.01)
    window.event("TIMER")
    go_on.set()
    window._job.wait()
    (shown,) = (line for line in window.log if isinstance(line, dict))
    assert shown == {"text": "Work: flatten 3 of 12 (Esc cancels)", "factor": 0.25, "type": "BAR"}


def test_an_unwrap_stops_soon(extension):
    job, unwrapping = (importlib.import_module(f"{extension}.{name}") for name in ("job", "unwrapping"))
    bpy.ops.mesh.primitive_monkey_add()
    thing = bpy.context.object
    thing.modifiers.new("finer", "SUBSURF").levels = 2
    bpy.ops.object.modifier_apply(modifier="finer")
    before = scenes.places(thing)
    parts = unwrapping.read_parts([thing], edited=False)
    options = {"keep_seams": False, "hard_edges": False, "around": False}
    one = job.Job(lambda callback: unwrapping.unwrap_parts(parts, **options, callback=callback))
    one.start()
    while one._thread.is_alive() and (one.step is None or one.step.phase == "clean"):
        one._thread.join(0.01)
    one.stop()
    began = time.perf_counter()
    one.wait()
    assert isinstance(one.error, KeyboardInterrupt)
    assert time.perf_counter() - began < 5
    assert np.array_equal(scenes.places(thing), before)


def test_buttons_of_the_panel(extension):
    panel = importlib.import_module(f"{extension}.panel")
    shown = []

    def operator(name, text=""):
        shown.append(name)
        return SimpleNamespace()

    column = SimpleNamespace(operator=operator, separator=lambda: None)
    curve = SimpleNamespace(type="CURVE", name="ring")
    panel._Buttons.draw(
        SimpleNamespace(layout=SimpleNamespace(column=lambda align: column)), SimpleNamespace(selected_objects=[curve])
    )
    assert set(shown) == {f"uv.qhm_{act}" for act in ALL}
    assert shown.count("uv.qhm_fit") == 4
    assert all(hasattr(bpy.types, f"UV_OT_{name.partition('.')[2]}") for name in shown)


@pytest.mark.parametrize("escape", [False, True])
def test_progress_and_escape(extension, escape):
    job = importlib.import_module(f"{extension}.job")
    stepped, go_on = threading.Event(), threading.Event()

    def work(reports_progress):
        reports_progress(SimpleNamespace(energy=0.25))
        stepped.set()
        go_on.wait(10)
        reports_progress(SimpleNamespace(energy=0.125))
        return "result"

    window = Looking(job, work)
    window._job.start()
    assert stepped.wait(10)
    assert window.event("TIMER") == {"RUNNING_MODAL"}
    assert any("energy 0.25 (Esc cancels)" in str(line) for line in window.log)
    if escape:
        assert window.event("ESC") == {"RUNNING_MODAL"}
    go_on.set()
    window._job.wait()
    assert window.event("TIMER") == ({"CANCELLED"} if escape else {"FINISHED"})
    assert window.log[-1] == ("Work: cancelled, nothing has changed" if escape else "result")
    assert all(line in window.log for line in ("timer", "end", None))


def test_what_single_precision_cannot_hold_is_said(said):
    # A ring around a point, a thousand million times smaller than the sheet.
    angle = 2 * np.pi * np.arange(80) / 80
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    V = np.concatenate([[[0, 0, 0]], 1e-9 * ring, ring])
    k, ahead = np.arange(80), (np.arange(80) + 1) % 80
    faces = [[0, 1 + i, 1 + j] for i, j in zip(k, ahead, strict=True)]
    faces += [[1 + i, 81 + i, 81 + j, 1 + j] for i, j in zip(k, ahead, strict=True)]
    thing = scenes.add_mesh(V, faces)
    assert bpy.ops.uv.qhm_flatten() == {"FINISHED"}
    wrong = scenes.verdict(thing).inverted
    assert wrong.size
    text = said()
    assert "Warning: Flatten" in text
    assert f"{wrong.size} triangles are too narrow for Blender's single precision" in text


def test_rounding_flips_nothing_that_nearby_numbers_do_not(extension):
    from quasiharmonic import atlas
    from quasiharmonic.surfaces import random_delaunay

    rounding = importlib.import_module(f"{extension}.rounding")
    V, F = random_delaunay(200, seed=2)
    spacing = float(np.spacing(np.float32(0.7)))
    uv = 0.7 + V * 12 * spacing
    plain = atlas.SeamedMesh(V, F, uv=uv.astype(np.float32).astype(float))
    assert atlas.certify(atlas.SeamedMesh(V, F, uv=uv)).injective
    assert not atlas.certify(plain).injective
    rounded = rounding.in_single_precision(atlas.SeamedMesh(V, F, uv=uv))
    assert atlas.certify(rounded).injective
    assert np.array_equal(rounded.uv, rounded.uv.astype(np.float32))
    assert abs(rounded.uv - uv).max() < 2 * spacing
