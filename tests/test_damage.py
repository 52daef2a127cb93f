"""Damaged files as input of the command: the campaign detects errors, and a part of it runs in the tests."""

from __future__ import annotations

import re

import pytest

import damage

pytestmark = pytest.mark.slow

CALLS = [(kind, call) for kind, calls in damage.CALLS.items() for call in calls]


@pytest.mark.parametrize(("kind", "call"), CALLS)
def test_what_is_not_damaged_is_taken(kind, call, tmp_path, monkeypatch):
    monkeypatch.setattr(damage, "damaged", lambda rng, data: data)
    monkeypatch.setitem(damage.CALLS, kind, [call])
    trial = damage.attempt(f"{kind}:0", damage.valid_files(), tmp_path)
    assert (trial.status, trial.fault) == (0, ""), trial.said


@pytest.mark.parametrize("kind", damage.CALLS)
def test_what_is_damaged_is_refused_or_done_right(kind):
    trials = list(damage.trials([f"{kind}:{seed}" for seed in range(100, 108)]))
    assert not [(trial.name, trial.fault, trial.said) for trial in trials if trial.fault]
    assert {trial.status for trial in trials} & {1, 2}


@pytest.mark.parametrize(
    ("trouble", "fault"),
    [
        ("raise KeyError('lost')", "exit status 70"),
        ("print('Warning: hm')", "a traceback or a warning"),
        ("raise SystemExit(2)", "a refusal that does not say who refuses"),
        ("print('qhm map: no'); open('out.obj', 'w').close(); raise SystemExit(2)", "left behind: out.obj"),
        ("print('qhm map: ' + 'no' * 2000); raise SystemExit(2)", "a refusal of 4010 characters"),
        ("__import__('signal').raise_signal(15)", "exit status -15"),
        ("__import__('time').sleep(60)", "exit status -9"),
        ("pass", "nothing written"),
        ("open('out.obj', 'w').write('v 0')", "written, and cannot be read: out.obj: "),
        ("__import__('shutil').copy('turned.obj', 'out.obj')", "certified, and not injective"),
    ],
)
def test_what_goes_wrong_is_seen(trouble, fault, tmp_path, monkeypatch):
    def troubled(arguments):
        exec(trouble)
        return 0

    monkeypatch.setattr(damage, "qhm", troubled)
    monkeypatch.setattr(damage, "SECONDS", 5.0)
    monkeypatch.setitem(damage.CALLS, "mesh.obj", ["map {} -o out.obj"])
    files = damage.valid_files()
    files["turned.obj"] = re.sub(rb"vt (\S+) (\S+)", rb"vt \2 \1", files["mesh.obj"])
    assert fault in damage.attempt("mesh.obj:0", files, tmp_path).fault.replace(f"{tmp_path}/", "")


def test_a_run_lists_what_went_wrong(monkeypatch, capsys):
    assert damage.main(["-n", "2", "--kinds", "handles.txt"]) == 0
    assert "0 failures among 2 files" in capsys.readouterr().out
    monkeypatch.setattr(damage, "qhm", lambda arguments: 5)
    assert damage.main(["--case", "handles.txt:3"]) == 1
    assert "handles.txt:3: exit status 5: qhm " in capsys.readouterr().out
