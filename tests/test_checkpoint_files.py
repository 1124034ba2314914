"""What is on the disk: torn, hostile and full."""

import errno
import hashlib
import json
import os
import shutil
from collections import OrderedDict

import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_mcbs import MCBSTD3, CheckpointError, ExactCheckpointCallback, resume
from sb3_mcbs.agents.hyperparameters import REMOVED
from sb3_mcbs.checkpoints import register_state, store
from sb3_mcbs.checkpoints.encoding import Decoder, Encoder
from sb3_mcbs.checkpoints.resume import read_run
from sb3_mcbs.checkpoints.store import Store, write_arrays, write_file
from sb3_mcbs.snapshot import SnapshotUnsupportedError
from tests.checkpoint_helpers import CrashAt, assert_same_parameters, crash, learn
from tests.test_checkpoints import maker

MAKE = maker(DDPG, buffer_size=1000, policy_kwargs=dict(net_arch=[8]))


@pytest.fixture(scope="module")
def lost_run(tmp_path_factory):
    """A run that was lost at 150 steps, with checkpoints at 80 and 120, and one that was not."""
    folder = tmp_path_factory.mktemp("runs")
    whole = learn(MAKE(folder / "whole"), folder / "whole", 200)
    crash(MAKE, folder / "lost", 200, 150)
    return folder / "lost", whole


@pytest.fixture
def folder(lost_run, tmp_path, monkeypatch):
    shutil.copytree(lost_run[0] / "checkpoints", tmp_path / "checkpoints")
    # Monitor's file is below neither the present folder nor the copy's.
    monkeypatch.chdir(lost_run[0].parent)
    return tmp_path


def files_of(checkpoints, step):
    return [
        checkpoints / f"step_{step:012d}" / name for name in ("manifest.json", "state.json", "arrays.npz")
    ]


def truncate(path):
    os.truncate(path, path.stat().st_size // 2)


def zero(path):
    path.write_bytes(bytes(path.stat().st_size))


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def remove(path):
    path.unlink()


@pytest.mark.parametrize("damage", [truncate, zero, flip, remove])
@pytest.mark.parametrize("name", ["manifest.json", "state.json", "arrays.npz", "rows"])
def test_a_damaged_checkpoint_is_passed_over(name, damage, folder, lost_run):
    checkpoints = folder / "checkpoints"
    assert Store(checkpoints).steps() == [120, 80]
    damaged = checkpoints / "step_000000000120" / name
    if name == "rows":
        damaged = checkpoints / "rows" / "000000000080-000000000120.npz"
    damage(damaged)
    with pytest.warns(UserWarning, match=f"damaged.*{damaged.name}.*The one at 80 steps is used"):
        agent = resume(checkpoints)
    learn(agent, folder, 200)
    assert_same_parameters(agent, lost_run[1])
    assert Store(checkpoints).steps() == [160, 120]
    Store(checkpoints).read(120)  # written again on the way


def test_an_old_manifest_is_named(folder):
    for path in (folder / "checkpoints").glob("*/manifest.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "format": 0}))
    with pytest.raises(
        CheckpointError, match=r"No checkpoint .* is whole.*format 0, this version .* format 1"
    ):
        resume(folder / "checkpoints")


def test_nothing_there(tmp_path):
    with pytest.raises(CheckpointError, match="There is no checkpoint in"):
        resume(tmp_path)


def test_one_checkpoint_may_be_named(folder, lost_run):
    agent = resume(folder / "checkpoints" / "step_000000000080")
    learn(agent, folder, 200)
    assert_same_parameters(agent, lost_run[1])


def test_half_written_files_are_no_checkpoint_and_go_away(folder):
    checkpoints = folder / "checkpoints"
    shutil.copytree(checkpoints / "step_000000000120", checkpoints / ".unfinished-step_000000000160")
    (checkpoints / "rows" / ".unfinished-x.npz").write_bytes(b"half")
    learn(resume(checkpoints), folder, 200)
    assert not list(checkpoints.rglob(".unfinished*"))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
@pytest.mark.parametrize("fails_at", [1, 2, 3, 4])
def test_a_full_disk_stops_nothing(code, fails_at, tmp_path, monkeypatch, lost_run):
    real, calls = os.fsync, []

    def fsync(handle):
        # The checkpoint at 40 steps flushes rows, their folder, state, arrays, manifest and folders.
        calls.append(handle)
        if n_before < len(calls) <= n_before + fails_at and len(calls) - n_before == fails_at:
            raise OSError(code, os.strerror(code))
        real(handle)

    n_before = 5  # of the checkpoint at the beginning
    monkeypatch.setattr(store.os, "fsync", fsync)
    agent = MAKE(tmp_path)
    with pytest.warns(UserWarning, match="No checkpoint could be written at 40 steps.*Training goes on"):
        learn(agent, tmp_path, 200)
    assert_same_parameters(agent, lost_run[1])
    assert Store(tmp_path / "checkpoints").steps() == [160, 120]
    assert not list((tmp_path / "checkpoints").rglob(".unfinished*"))
    Store(tmp_path / "checkpoints").read(160)


def test_a_folder_that_has_vanished_is_made_again(tmp_path, lost_run):
    class Remove(CrashAt):
        """Here it is the folder that is lost, not the run."""

        def _on_step(self):
            if self.num_timesteps == 100 and not resumed:
                shutil.rmtree(tmp_path / "checkpoints")
            return True

    resumed = None
    MAKE(tmp_path).learn(200, callback=[ExactCheckpointCallback(40, tmp_path / "checkpoints"), Remove()])
    assert Store(tmp_path / "checkpoints").steps() == [160, 120]
    resumed = resume(tmp_path / "checkpoints")
    resumed.learn(200, callback=[ExactCheckpointCallback(40, tmp_path / "checkpoints"), Remove()])
    assert_same_parameters(resumed, lost_run[1])


def test_a_failure_says_what_to_do(tmp_path, monkeypatch):
    def no_room(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Store, "write", no_room)
    message = "at 40 steps: .*No space left.*the next one is due at 80 steps.*Make room on the disk"
    with pytest.warns(UserWarning, match=message):
        learn(MAKE(tmp_path), tmp_path, 50)


def test_a_later_damaged_checkpoint_does_not_take_the_place_of_a_new_one(folder):
    """A run that goes on from 80 steps, since the checkpoint at 120 is damaged, may be stopped at 100."""
    checkpoints = Store(folder / "checkpoints")
    truncate(checkpoints.path_of(120) / "state.json")
    shutil.copytree(checkpoints.path_of(80), checkpoints.path_of(100))
    checkpoints.clean(1, newest=100)
    assert checkpoints.steps() == [120, 100]
    checkpoints.read(100)


def test_a_run_may_go_on_in_another_folder(folder, lost_run):
    agent = resume(folder / "checkpoints")
    agent.learn(200, callback=[ExactCheckpointCallback(40, folder / "other"), CrashAt()])
    assert Store(folder / "checkpoints").steps() == [120, 80]
    shutil.rmtree(folder / "checkpoints")
    resumed = resume(folder / "other")
    resumed.learn(200, callback=[ExactCheckpointCallback(40, folder / "other"), CrashAt()])
    assert_same_parameters(resumed, lost_run[1])


def test_the_other_folder_may_not_be_that_of_another_run(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    shutil.copytree(folder / "checkpoints", other / "checkpoints")
    with pytest.raises(CheckpointError, match="holds the checkpoints of a run"):
        learn(resume(folder / "checkpoints"), other, 200)


def test_nothing_is_left_to_be_flushed_later(tmp_path):
    """``python -X dev`` says so of files that fail when they are collected."""
    files = []
    write_file(tmp_path / "file", files.append)
    write_arrays(tmp_path / "arrays.npz", {"a": np.zeros(3)})
    assert files[0].closed


def test_disk_use_stays_below_twice_the_buffer(tmp_path):
    make = maker(DDPG, buffer_size=100, learning_starts=10_000)
    learn(make(tmp_path), tmp_path, 1000, save_freq=20)
    rows = [np.load(path)["positions"].size for path in (tmp_path / "checkpoints" / "rows").glob("*")]
    assert 100 <= sum(rows) < 200


def test_cost_follows_what_is_new(tmp_path, monkeypatch):
    written = []
    real = store.write_arrays
    monkeypatch.setattr(
        store,
        "write_arrays",
        lambda path, arrays: written.append(len(arrays.get("positions", ()))) or real(path, arrays),
    )
    make = maker(DDPG, buffer_size=1000, learning_starts=10_000)
    learn(make(tmp_path), tmp_path, 500, save_freq=20)
    assert {rows for rows in written if rows} == {22}


def change_manifest(checkpoint, change):
    """Change what a manifest says, as somebody would who knows the format."""
    path = checkpoint / "manifest.json"
    text = json.dumps(store.read_manifest(checkpoint))
    changed = change(text)
    assert changed != text
    path.write_text(json.dumps(store.seal_manifest(json.loads(changed))))


def reseal(checkpoint, name):
    """Make a changed file one that its manifest vouches for."""
    content = (checkpoint / name).read_bytes()

    def change(text):
        seal = [len(content), hashlib.sha256(content).hexdigest()]
        manifest = json.loads(text)
        return json.dumps({**manifest, "files": {**manifest["files"], name: seal}})

    change_manifest(checkpoint, change)


@pytest.mark.parametrize("name", REMOVED)
def test_a_run_from_before_a_setting_was_removed(name, tmp_path):
    """By an agent of its own, and by one that is there already, as in RL Zoo."""
    crash(maker(MCBSTD3), tmp_path, 60, 45)
    with_setting = json.dumps({name: REMOVED[name][0]})[1:-1]
    for step in Store(tmp_path / "checkpoints").steps():
        checkpoint = Store(tmp_path / "checkpoints").path_of(step)
        change_manifest(
            checkpoint, lambda text: text.replace('"beam_noise"', f'{with_setting}, "beam_noise"', 1)
        )
    message = rf"settings that were removed since then: {name} \(.+\)\. Continue it with the version"
    with pytest.raises(CheckpointError, match=message):
        resume(tmp_path / "checkpoints")
    agent = maker(MCBSTD3)(tmp_path)
    read_run(tmp_path / "checkpoints").continue_with(agent)
    with pytest.raises(CheckpointError, match=message):
        learn(agent, tmp_path, 60)


class TestHostile:
    @pytest.fixture
    def checkpoint(self, folder):
        shutil.rmtree(folder / "checkpoints" / "step_000000000080")
        return folder / "checkpoints" / "step_000000000120"

    def change_state(self, checkpoint, old, new):
        path = checkpoint / "state.json"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))
        reseal(checkpoint, "state.json")

    @pytest.mark.parametrize(
        "name", ["class os._wrap_close", "class subprocess.Popen", "compiled posix.system"]
    )
    def test_a_class_that_is_not_used_here(self, checkpoint, name, folder):
        self.change_state(checkpoint, '"class numpy.random._pcg64.PCG64"', json.dumps(name))
        with pytest.raises(CheckpointError, match="neither this agent nor its environments use"):
            learn(resume(checkpoint.parent), folder, 200)

    def test_a_call(self, checkpoint, folder):
        state = json.loads((checkpoint / "state.json").read_text())
        nodes = state["run"]["nodes"]
        index = next(i for i, (kind, _) in enumerate(nodes) if kind == "reduced")
        nodes[index][1]["tuple"][0] = {"name": "class builtins.list"}
        (checkpoint / "state.json").write_text(json.dumps(state))
        reseal(checkpoint, "state.json")
        with pytest.raises(CheckpointError, match="asks for a call"):
            learn(resume(checkpoint.parent), folder, 200)

    def test_the_class_of_the_agent(self, checkpoint):
        change_manifest(
            checkpoint, lambda text: text.replace('"class stable_baselines3.ddpg', '"class other')
        )
        with pytest.raises(CheckpointError, match="class other"):
            resume(checkpoint.parent)

    def test_rows_elsewhere(self, checkpoint, folder):
        outside = folder / "000000000080-000000000120.npz"
        shutil.copy(folder / "checkpoints" / "rows" / outside.name, outside)
        change_manifest(checkpoint, lambda text: text.replace(f'"{outside.name}"', f'"../../{outside.name}"'))
        with pytest.raises(CheckpointError, match=r"names '\.\./\.\./0.* as a file with rows"):
            resume(checkpoint.parent)

    def test_an_environment_that_is_not_registered(self, checkpoint):
        change_manifest(checkpoint, lambda text: text.replace('"id": "Pendulum-v1"', '"id": "os:system"'))
        with pytest.raises(CheckpointError, match="'os:system' is not registered here"):
            resume(checkpoint.parent)

    def test_a_log_file_elsewhere(self, checkpoint, monkeypatch, tmp_path_factory):
        monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
        with pytest.raises(CheckpointError, match="log_folder="):
            resume(checkpoint.parent)

    def test_a_pickle_among_the_arrays(self, checkpoint, tmp_path):
        class Payload:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "executed"),)

        arrays = dict(np.load(checkpoint / "arrays.npz"))
        np.savez(checkpoint / "arrays.npz", **arrays, extra=np.array([Payload()], dtype=object))
        reseal(checkpoint, "arrays.npz")
        with pytest.raises(CheckpointError, match="cannot be read"):
            resume(checkpoint.parent)
        assert not (tmp_path / "executed").exists()
        np.load(checkpoint / "arrays.npz", allow_pickle=True)["extra"]
        assert (tmp_path / "executed").exists(), "the payload is live"

    def test_compressed_arrays(self, checkpoint):
        np.savez_compressed(checkpoint / "arrays.npz", zeros=np.zeros(10**6))
        reseal(checkpoint, "arrays.npz")
        with pytest.raises(CheckpointError, match="compressed"):
            resume(checkpoint.parent)

    def test_numbers_that_are_not_there(self, checkpoint, folder):
        state = json.loads((checkpoint / "state.json").read_text())

        def grow(value):
            if isinstance(value, dict) and "array" in value:
                value["array"][1] = 10**9
            for item in (
                value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
            ):
                grow(item)

        grow(state)
        (checkpoint / "state.json").write_text(json.dumps(state))
        reseal(checkpoint, "state.json")
        with pytest.raises(CheckpointError, match="beyond those that it holds"):
            learn(resume(checkpoint.parent), folder, 200)


class Celsius:
    """Keeps its number where no checkpoint looks."""

    __slots__ = ("_hidden",)

    def __init__(self, degrees):
        self._hidden = iter([degrees])


VALUES = [
    None, True, 7, 2**80, -0.0, float("inf"), "text", b"bytes", [1, [2]], (1, (2,)), {"a": {1: 2}}, 1 + 2j,
    np.float32(0.1), np.int64(-3), np.array(1.5), np.arange(6).reshape(2, 3).T, np.array(["a", "bc"]),
    np.zeros((0, 3)), np.dtype(np.float32), np.array([True, False]),
]  # fmt: skip


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_values_go_through_json(value):
    encoder = Encoder()
    data = json.loads(json.dumps(encoder.encode(value), allow_nan=False))
    again = Decoder(encoder.arrays, {}).decode(data)
    assert type(again) is type(value)
    if isinstance(value, np.ndarray):
        assert again.dtype == value.dtype
        assert again.flags.f_contiguous == value.flags.f_contiguous
        assert np.array_equal(again, value)
    else:
        assert repr(again) == repr(value)


def test_a_class_without_functions_is_refused_and_named():
    with pytest.raises(CheckpointError, match=r"Celsius.*register_state"):
        Encoder().encode(Celsius(20))


def test_a_registered_pair_of_functions():
    register_state(Celsius, lambda celsius: next(celsius._hidden), Celsius)
    encoder = Encoder()
    data = encoder.encode([Celsius(21.5)])
    (again,) = Decoder(encoder.arrays, {}).decode(data)
    assert next(again._hidden) == 21.5
    with pytest.raises(TypeError, match="class and two functions"):
        register_state(Celsius, None, Celsius)


def test_ordered_dictionaries_are_the_only_calls():
    from sb3_mcbs.checkpoints.handlers import handler_of
    from sb3_mcbs.snapshot.object_graph import Capture

    capture = Capture(handler_of, {}, 0)
    capture(OrderedDict(a=1))
    Encoder().encode_nodes(tuple(capture.nodes))
    with pytest.raises(SnapshotUnsupportedError, match="range_iterator cannot be written as data"):
        capture(range(3).__iter__())
    # What an environment holds was captured without that check.
    with pytest.raises(CheckpointError, match="made by calling"):
        Encoder().encode_nodes((("reduced", (iter, (), None, (), ())),))
