"""Model files whose author means harm, or that are damaged."""

import functools
import io
import json
import pickle
import zipfile

import numpy as np
import pytest
import torch as th
from rl_zoo3.utils import get_saved_hyperparams
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_mcbs import MCBSTD3, AgentFileError, load_agent
from sb3_mcbs.loading import agent_file, archive
from tests import agent_files as files


@pytest.fixture
def saved(make_agent, tmp_path):
    """Make an agent, save it, and return both."""
    return functools.partial(files.save_agent, make_agent, tmp_path)


def load(path, env="Pendulum-v1", **kwargs):
    return load_agent(path, env, device="cpu", **kwargs)


# Code


def executes(load_it) -> None:
    """Run a trusting loader, which may fail after the payload ran."""
    try:
        load_it()
    except Exception as reason:
        print(type(reason).__name__, reason)


@pytest.mark.parametrize(
    "entry",
    [
        "policy_class", "policy_kwargs", "lr_schedule", "learning_rate", "action_noise", "observation_space",
        "action_space", "replay_buffer_class", "replay_buffer_kwargs", "train_freq", "ep_info_buffer",
        "_last_obs", "gamma", "beam_width", "search_rng", "tensorboard_log", "an_entry_of_its_own",
    ],
)  # fmt: skip
def test_payload_in_an_entry_does_not_run(saved, tmp_path, entry):
    _, path = saved(MCBSTD3)
    flag = tmp_path / "flag"
    readable = json.loads(files.members_of(path)["data"]).get(entry)
    readable = (
        {key: value for key, value in readable.items() if key[0] != ":"} if isinstance(readable, dict) else {}
    )
    readable[":type:"] = "<class 'dict'>"
    strange = files.with_data(
        path, tmp_path / "strange.zip", **{entry: files.payload_entry(flag, **readable)}
    )
    executes(lambda: MCBSTD3.load(strange, device="cpu"))
    assert flag.exists(), "the test's payload has to run where it is trusted"
    flag.unlink()
    loaded = load(strange)
    assert not flag.exists()
    assert loaded.not_taken_over[entry]


def test_number_stored_as_a_pickle_is_warned_of(saved, tmp_path, caplog):
    _, path = saved(TD3, gamma=0.9)
    strange = files.with_data(path, tmp_path / "strange.zip", gamma=files.payload_entry(tmp_path / "flag"))
    assert load(strange).gamma == 0.99
    assert "gamma is not there as a plain value" in caplog.text


@pytest.mark.parametrize("new_format", [True, False])
def test_payload_in_the_policy_does_not_run(saved, tmp_path, new_format):
    _, path = saved(TD3)
    flag = tmp_path / "flag"
    state = files.tensors_of(path) | {"actor.extra": files.Payload(flag)}
    strange = files.with_policy(path, tmp_path / "s.zip", state, _use_new_zipfile_serialization=new_format)
    th.load(io.BytesIO(files.members_of(strange)["policy.pth"]), weights_only=False)
    assert flag.exists()
    flag.unlink()
    with pytest.raises(AgentFileError, match=r"s\.zip: 'policy.pth' cannot be read"):
        load(strange)
    assert not flag.exists()


def test_plain_pickle_for_a_policy_does_not_run(saved, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    _, path = saved(TD3)
    members = files.members_of(path) | {"policy.pth": pickle.dumps(files.Payload(tmp_path / "flag"), 2)}
    with pytest.raises(AgentFileError, match=r"'policy\.pth' cannot be read"):
        load(files.write(tmp_path / "strange.zip", members))
    assert not (tmp_path / "flag").exists()


@pytest.mark.parametrize(
    "member", ["pytorch_variables.pth", "tensors.pth", "actor.optimizer.pth", "extra.pth", "extra.pkl"]
)
def test_other_members_are_not_opened(saved, tmp_path, member):
    _, path = saved(TD3)
    flag = tmp_path / "flag"
    content = pickle.dumps(files.Payload(flag))
    strange = files.write(tmp_path / "strange.zip", {**files.members_of(path), member: content})
    loaded = load(strange)
    assert not flag.exists()
    files.assert_same_agent(loaded, TD3.load(path, device="cpu"))
    assert loaded.not_taken_over[member] == "a member that is not read"
    pickle.loads(content)
    assert flag.exists()


def test_files_of_rl_zoo_beside_the_agent_are_not_read(saved, tmp_path):
    _, path = saved(SAC)
    flag = tmp_path / "flag"
    for name in ("config.yml", "args.yml", "env_kwargs.yml"):
        (tmp_path / name).write_text(f"n_envs: !!python/object/apply:os.mkdir [{flag}]\n")
    for name in ("vecnormalize.pkl", "obs_rms.pkl"):
        (tmp_path / name).write_bytes(pickle.dumps(files.Payload(flag)))
    load(path)
    assert not flag.exists()
    executes(lambda: get_saved_hyperparams(str(tmp_path)))
    flag.rmdir()  # which exists, because RL Zoo's reader made it
    executes(lambda: VecNormalize.load(tmp_path / "vecnormalize.pkl", make_vec_env("Pendulum-v1", 1)))
    assert flag.exists()


def test_old_format_of_torch_is_read(saved, tmp_path):
    _, path = saved(SAC)
    old = files.with_policy(
        path, tmp_path / "old.zip", files.tensors_of(path), _use_new_zipfile_serialization=False
    )
    files.assert_same_agent(load(old), SAC.load(path, device="cpu"))


# Damage


@pytest.mark.parametrize("name", ["../outside", "/outside", "..\\outside", "a/../../outside"])
def test_names_cannot_point_outside(saved, tmp_path, name):
    _, path = saved(TD3)
    folder = tmp_path / "inner"
    folder.mkdir()
    strange = files.write(folder / "strange.zip", {**files.members_of(path), name: b"x"})
    before = sorted(tmp_path.rglob("*"))
    load(strange)
    assert sorted(tmp_path.rglob("*")) == before
    members = files.members_of(path)
    members[f"../{'policy.pth'}"] = members.pop("policy.pth")
    with pytest.raises(AgentFileError, match=r"has no member 'policy\.pth'"):
        load(files.write(folder / "other.zip", members))


def test_missing_members(saved, tmp_path):
    _, path = saved(TD3)
    for name in ("data", "policy.pth"):
        members = files.members_of(path)
        del members[name]
        with pytest.raises(AgentFileError, match=rf"missing\.zip: this is no SB3 model file.*'{name}'"):
            load(files.write(tmp_path / "missing.zip", members))


def test_truncated_anywhere(saved, tmp_path):
    _, path = saved(TD3)
    content = path.read_bytes()
    short = tmp_path / "short.zip"
    for length in [0, 1, 100, *range(1000, len(content), 2000), len(content) - 1]:
        short.write_bytes(content[:length])
        with pytest.raises(AgentFileError, match=r"short\.zip"):
            load(short)


def test_flipped_bytes_never_end_in_another_error(saved, tmp_path):
    _, path = saved(SAC, policy_kwargs=dict(net_arch=[2]))
    content = path.read_bytes()
    broken, rng = tmp_path / "broken.zip", np.random.default_rng(0)
    refused = 0
    for at in rng.integers(len(content), size=150):
        changed = bytearray(content)
        changed[at] ^= int(rng.integers(1, 256))
        broken.write_bytes(changed)
        try:
            load(broken)
        except ValueError:
            refused += 1
    assert refused > 20


def test_not_a_zip(tmp_path):
    path = tmp_path / "agent.zip"
    path.write_bytes(pickle.dumps(files.Payload(tmp_path / "flag")))
    with pytest.raises(AgentFileError, match=r"agent\.zip: the zip file cannot be read.*not a zip"):
        load(path)


def test_members_twice(saved, tmp_path):
    _, path = saved(TD3)
    strange = files.write(tmp_path / "strange.zip", files.members_of(path))
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(strange, "a") as opened:
        opened.writestr("data", "{}")
    with pytest.raises(AgentFileError, match="more than one member 'data'"):
        load(strange)


def test_encrypted_and_unusual_compression(saved, tmp_path):
    _, path = saved(TD3)
    encrypted = tmp_path / "encrypted.zip"
    encrypted.write_bytes(files.claim_encryption(path.read_bytes(), "data"))
    with pytest.raises(AgentFileError, match="'data' is encrypted"):
        load(encrypted)
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        strange = files.write(tmp_path / "strange.zip", files.members_of(path), method)
        with pytest.raises(AgentFileError, match="'data' is compressed with method"):
            load(strange)
    assert (
        type(load(files.write(tmp_path / "small.zip", files.members_of(path), zipfile.ZIP_DEFLATED))) is TD3
    )


@pytest.mark.parametrize("name", ["data", "policy.pth"])
def test_oversized_members(saved, tmp_path, monkeypatch, name):
    _, path = saved(TD3)
    monkeypatch.setattr(agent_file, "MAX_DATA_BYTES", 100_000)
    monkeypatch.setattr(agent_file, "MAX_POLICY_BYTES", 100_000)
    members = files.members_of(path)
    bomb = files.write(tmp_path / "bomb.zip", {**members, name: bytes(10_000_000)}, zipfile.ZIP_DEFLATED)
    assert bomb.stat().st_size < 100_000
    with pytest.raises(AgentFileError, match=f"'{name}' has more than 100000 bytes"):
        load(bomb)
    bomb.write_bytes(files.claim_size(bomb.read_bytes(), name, 5_000))
    with pytest.raises(AgentFileError, match=r"bomb\.zip: the zip file cannot be read.*CRC"):
        load(bomb)
    bomb.write_bytes(files.claim_size(path.read_bytes(), name, 2**32 - 2))
    with pytest.raises(AgentFileError, match=f"'{name}' has more than 100000 bytes"):
        load(bomb)


def test_oversized_file(saved, monkeypatch):
    _, path = saved(TD3)
    monkeypatch.setattr(archive, "MAX_FILE_BYTES", 1000)
    with pytest.raises(AgentFileError, match="at most 1000 are read"):
        load(path)


def test_bomb_inside_the_policy(saved, tmp_path):
    _, path = saved(TD3)
    members = files.members_of(path)
    inner = files.write(tmp_path / "inner.zip", members)
    inner.write_bytes(members["policy.pth"])
    packed = files.members_of(inner) | {"archive/data/0": bytes(10_000_000)}
    bomb = files.write(tmp_path / "packed.zip", packed, zipfile.ZIP_DEFLATED).read_bytes()
    with pytest.raises(AgentFileError, match=r"members of 'policy\.pth' are larger than their file"):
        load(files.write(tmp_path / "bomb.zip", {**members, "policy.pth": bomb}))


def test_tensors_that_claim_more_than_they_have(saved, tmp_path):
    """A view repeats one number without memory; networks of its shape would need gigabytes."""
    _, path = saved(TD3)
    state = files.tensors_of(path)
    state["critic.qf0.0.weight"] = th.zeros(1).expand(200_000, 200_000)
    with pytest.raises(AgentFileError, match="larger than their file"):
        load(files.with_policy(path, tmp_path / "strange.zip", state))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("actor.mu.2.weight", lambda t: t * np.nan, r"'actor.mu.2.weight' has values that are infinite"),
        ("critic.qf1.0.bias", lambda t: t + np.inf, r"'critic.qf1.0.bias' has values that are infinite"),
        ("actor.mu.2.bias", lambda t: t.double(), r"must be dense float32"),
        ("actor.mu.2.bias", lambda t: t.to_sparse(), r"must be dense float32|cannot be read"),
        ("actor.mu.2.bias", lambda t: t.to("meta"), r"must be dense float32|cannot be read"),
        ("actor.mu.2.bias", lambda t: [1.0], r"only tensors by name"),
        ("actor.mu.2.bias", lambda t: th.zeros(7), r"'actor.mu.2.bias' has the shape \(7,\), but \(16,\)"),
        ("actor.mu.0.weight", lambda t: th.zeros(()), r"not those of a TD3"),
        ("critic.qf1.0.weight", lambda t: th.zeros(16, 5), r"has the shape \(16, 5\), but \(16, 4\)"),
        ("critic.qf7.0.weight", lambda t: th.zeros(16, 4), r"has a tensor 'critic.qf7.0.weight' that SB3's"),
        ("actor.mu.1.weight", lambda t: th.zeros(16), r"has a tensor 'actor.mu.1.weight' that SB3's"),
    ],
)  # fmt: skip
def test_wrong_tensors(saved, tmp_path, name, change, message):
    _, path = saved(TD3)
    state = files.tensors_of(path)
    state[name] = change(state.get(name))
    with pytest.raises(AgentFileError, match=message) as error:
        load(files.with_policy(path, tmp_path / "strange.zip", state))
    assert "strange.zip" in str(error.value)


def test_missing_tensor_and_no_dictionary(saved, tmp_path):
    _, path = saved(TD3)
    state = files.tensors_of(path)
    del state["critic_target.qf1.2.bias"]
    with pytest.raises(AgentFileError, match=r"'critic_target\.qf1\.2\.bias' is missing"):
        load(files.with_policy(path, tmp_path / "strange.zip", state))
    with pytest.raises(AgentFileError, match="must hold tensors by name, not a list"):
        load(files.with_policy(path, tmp_path / "strange.zip", [th.zeros(1)]))


FIRST = "critic.qf0.0"  # batch renormalization of CrossQ


@pytest.mark.parametrize(
    ("cls", "tensors", "words"),
    [
        (CrossQ, {f"{FIRST}.ra_var": -th.ones(4)}, "variances below 0"),
        (CrossQ, {f"{FIRST}.ra_var": None}, r"'critic\.qf0\.0\.ra_var' is missing"),
        (CrossQ, {f"{FIRST}.ra_mean": th.zeros(4, dtype=th.int64)}, "must be dense float32"),
        (CrossQ, {f"{FIRST}.steps": th.zeros(2)}, r"steps' has the shape \(2,\)"),
        (CrossQ, {"critic_target.qf0.1.weight": th.zeros(16, 4)}, "that SB3's MlpPolicy does not have"),
        (SAC, {f"{FIRST}.ra_mean": th.zeros(4)}, "not those of a TD3"),
        (TD3, {f"{FIRST}.ra_mean": th.zeros(4)}, "not those of a TD3"),
    ],
)
def test_normalization_is_whole_and_of_crossq_only(saved, tmp_path, cls, tensors, words):
    _, path = saved(cls)
    state = {**files.tensors_of(path), **tensors}
    state = {name: tensor for name, tensor in state.items() if tensor is not None}
    with pytest.raises(AgentFileError, match=words):
        load(files.with_policy(path, tmp_path / "strange.zip", state))


@pytest.mark.parametrize("eps", [0, -1, True, 10**400, "0.001", None])
def test_the_normalizations_constant_is_checked(saved, tmp_path, eps):
    _, path = saved(CrossQ)
    strange = files.with_data(path, tmp_path / "strange.zip", policy_kwargs={"batch_norm_eps": eps})
    with pytest.raises(AgentFileError, match=r"strange\.zip: batch_norm_eps must be"):
        load(strange)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("gamma", 0), ("gamma", 1.5), ("gamma", True), ("gamma", "0.9"), ("gamma", float("nan")),
        ("gamma", [0.9]), ("gamma", 10**400), ("gamma", {"a": 1}), ("gamma", None),
        ("ent_coef", -1), ("ent_coef", "auto_"), ("ent_coef", "auto_1_1"), ("ent_coef", float("inf")),
        ("top_quantiles_to_drop_per_net", 25), ("top_quantiles_to_drop_per_net", -1),
        ("top_quantiles_to_drop_per_net", 2.0), ("top_quantiles_to_drop_per_net", True),
    ],
)  # fmt: skip
def test_numbers_are_checked(saved, tmp_path, entry, value):
    _, path = saved(TQC)
    strange = files.with_data(path, tmp_path / "strange.zip", **{entry: value})
    with pytest.raises(AgentFileError, match=rf"strange\.zip: {entry} must be"):
        load(strange)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("beam_width", 0), ("beam_width", True), ("beam_width", 10**9), ("rollout_depth", 2.5),
        ("beam_noise", float("nan")), ("beam_noise", 10**400), ("forward_model", ["auto"]),
        ("model_kwargs", {"n_threads": 10**6}), ("model_kwargs", [1]), ("strategy", ["beam"]),
        ("search_kwargs", {"include_policy_action": 1}), ("search_kwargs", {"time_budget": "now"}),
        ("search_kwargs", {"branching": 2}), ("search_kwargs", 3),
    ],
)  # fmt: skip
def test_search_settings_are_checked(saved, tmp_path, entry, value):
    _, path = saved(MCBSTD3)
    with pytest.raises(AgentFileError, match=r"strange\.zip: search settings: .*"):
        load(files.with_data(path, tmp_path / "strange.zip", **{entry: value}))


def test_settings_of_an_older_file_are_checked(saved, tmp_path):
    _, path = saved(MCBSTD3)
    flat = dict(search_kwargs=None, model_kwargs=None, branching=7, antithetic=True, n_threads=2)
    agent = load(files.with_data(path, tmp_path / "older.zip", **flat))
    assert agent.search_settings.antithetic and agent.model_kwargs == {"n_threads": 2}
    assert not {"antithetic", "n_threads", "search_kwargs"} & agent.not_taken_over.keys()
    for entry, value in (("n_threads", 10**6), ("antithetic", {}), ("rollout_noise", -1)):
        with pytest.raises(AgentFileError, match=r"strange\.zip: search settings: .*"):
            load(files.with_data(path, tmp_path / "strange.zip", **{**flat, entry: value}))


def test_clip_mean_is_checked(saved, tmp_path):
    _, path = saved(SAC, use_sde=True)
    for entry in (dict(clip_mean=-1), dict(clip_mean=True), dict(clip_mean=10**400), dict(use_expln=2)):
        with pytest.raises(AgentFileError, match=rf"strange\.zip: {next(iter(entry))} must be"):
            load(files.with_data(path, tmp_path / "strange.zip", policy_kwargs=entry))


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "[1]", "{", "\xff", '{"gamma": ' + "9" * 10_000 + "}", "null"]
)
def test_strange_json(saved, tmp_path, text):
    _, path = saved(TD3)
    members = files.members_of(path) | {"data": text.encode("latin-1")}
    with pytest.raises(AgentFileError, match=r"strange\.zip: 'data'"):
        load(files.write(tmp_path / "strange.zip", members))
