import bpy
from scenes import add_suzanne


def test_installed_and_enabled(extension):
    assert extension in bpy.context.preferences.addons
    assert hasattr(bpy.types, "QHM_PT_uv")


def test_check(capfd):
    thing = add_suzanne()
    print(bpy.ops.uv.qhm_check())
    print(capfd.readouterr())
    bpy.ops.uv.qhm_flatten()
    print(bpy.ops.uv.qhm_check())
    print(bpy.ops.uv.qhm_flatten(cut=True))
    print(bpy.ops.uv.qhm_reduce_stretch(free=True))
    print(bpy.ops.uv.qhm_reduce_stretch())
    print(bpy.ops.uv.qhm_repair())
    bpy.ops.object.mode_set(mode="EDIT")
    print(bpy.ops.uv.qhm_repair())
    try:
        print(bpy.ops.uv.qhm_fit())
    except RuntimeError as e:
        print(repr(e))
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.mesh.primitive_grid_add()
    for to in ("RECTANGLE", "DISK", "LETTER", "CURVE"):
        try:
            print(bpy.ops.uv.qhm_fit(to=to))
        except RuntimeError as e:
            print(repr(e))
    assert 0
