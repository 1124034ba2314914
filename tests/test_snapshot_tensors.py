"""Snapshots of tensors, and of arrays in the memory of other objects."""

import array
import ctypes
import operator
import warnings

import numpy as np
import pytest
import torch as th
from scipy.spatial.transform import Rotation
from stable_baselines3 import PPO

from sb3_mcbs.snapshot import SnapshotEnvWrapper, SnapshotUnsupportedError
from tests.test_snapshot_graph import Small, follow
from tests.test_snapshot_kinds import assert_same_future


class Learning(Small):
    def prepare(self):
        with th.random.fork_rng():
            th.manual_seed(0)
            self.network = th.nn.Sequential(th.nn.Linear(1, 4), th.nn.BatchNorm1d(4), th.nn.Linear(4, 1))
        self.optimizer = th.optim.Adam(self.network.parameters(), lr=0.1)
        self.generator = th.Generator().manual_seed(1)

    def advance(self):
        loss = self.network(th.rand((3, 1), generator=self.generator)).square().sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return loss.item()


def test_networks_and_optimizers():
    env, clone = assert_same_future(Learning)
    for target in (env, clone):
        network, optimizer = target.unwrapped.network, target.unwrapped.optimizer
        assert all(map(operator.is_, network.parameters(), optimizer.param_groups[0]["params"]))
    weight = env.unwrapped.network[0].weight
    grad = weight.grad.clone()
    state = env.snapshot()
    follow(env, 1)
    assert not th.equal(weight.grad, grad)
    env.restore(state)
    assert env.unwrapped.network[0].weight is weight and th.equal(weight.grad, grad)


class Scheduled(Small):
    """Schedulers and recurrent networks hold weak references; hooks and tensors' attributes are state."""

    def prepare(self):
        with th.random.fork_rng():
            th.manual_seed(0)
            self.network = th.nn.LSTM(1, 2)
        self.optimizer = th.optim.SGD(self.network.parameters(), lr=0.1, momentum=0.9)
        self.scheduler = th.optim.lr_scheduler.CosineAnnealingLR(self.optimizer, 7)
        self.calls, self.memory = [0.0], None
        self.network.register_forward_hook(self.count)
        self.mark = th.zeros(1)
        self.mark.uses = [0]

    def count(self, module, inputs, output):
        self.calls[0] += 1.0

    def advance(self):
        output, memory = self.network(th.ones(1, 1, 1), self.memory)
        self.memory = tuple(part.detach() for part in memory)
        self.mark.uses[0] += 1
        self.optimizer.zero_grad()
        output.sum().backward()
        self.optimizer.step()
        self.scheduler.step()
        return output.sum().item() + self.calls[0] + self.scheduler.get_last_lr()[0] + self.mark.uses[0]


class Opponent(Small):
    """Plays against an agent of SB3."""

    def prepare(self):
        self.agent = PPO("MlpPolicy", "Pendulum-v1", seed=0, device="cpu", n_steps=64)
        self.place = np.array([1.0, 0.0, 0.0], np.float32)

    def advance(self):
        self.place[1] += 0.1
        self.agent.policy.log_std.data += 0.01
        action, _ = self.agent.predict(self.place, deterministic=True)
        return float(action[0] + self.agent.policy.log_std.data.sum())


@pytest.mark.parametrize("cls", [Scheduled, Opponent])
def test_schedulers_hooks_and_agents(cls):
    assert_same_future(cls)


class SharedMemory(Small):
    def prepare(self):
        self.whole = th.zeros(4, dtype=th.float64)
        self.part, self.numpy = self.whole[1:3], self.whole.numpy()
        self.half = th.zeros(2, dtype=th.bfloat16)

    def advance(self):
        self.part += 1
        self.numpy[0] += 1
        self.half += 1
        return float(self.whole.sum()) + self.numpy[1] + float(self.half.sum())


def test_tensors_that_share_memory():
    for target in assert_same_future(SharedMemory):
        inner = target.unwrapped
        inner.part[0] = 77
        assert inner.whole[1] == inner.numpy[1] == 77
    env, clone = assert_same_future(SharedMemory)
    assert env.unwrapped.whole.data_ptr() != clone.unwrapped.whole.data_ptr()


NUMBERS = np.zeros(3)


def quantized():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return th.quantize_per_tensor(th.ones(3), 0.1, 0, th.qint8)


def scripted():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return th.jit.trace(th.nn.Linear(1, 1), th.ones(1))


def hooked():
    tensor = th.zeros(1, requires_grad=True)
    tensor.register_hook(lambda grad: 2 * grad)
    return tensor


@pytest.mark.parametrize(
    "value, reason",
    [
        ({"numbers": NUMBERS, "tensor": th.from_numpy(NUMBERS)}, r"memory of a NumPy array of shape \(3,\)"),
        (th.nn.Linear(1, 1)(th.ones(1)), r"Small\.thing cannot .* history of gradients; keep its detach\(\)"),
        ([th.eye(2).to_sparse()], r"Small\.thing\[0\] cannot .* layout torch\.sparse_coo is no plain tensor"),
        (th.zeros(1, device="meta"), r"Small\.thing cannot .* is_meta is true"),
        (th.ones(1, dtype=th.complex64).conj(), r"Small\.thing cannot .* is_conj is true"),
        (quantized(), r"Small\.thing cannot .* is_quantized is true"),
        (hooked(), r"Small\.thing cannot .* with hooks"),
        (scripted(), r"Small\.thing.*torch\.ScriptModule"),
        (iter(th.utils.data.DataLoader([1.0])), r"Small\.thing\._sampler_iter"),
    ],
    ids=["from_numpy", "history", "sparse", "meta", "conj", "quantized", "hooks", "script", "loader"],
)
def test_tensors_that_are_refused(value, reason):
    env = Small()
    env.thing = value
    with pytest.raises(SnapshotUnsupportedError, match=reason):
        SnapshotEnvWrapper(env)


class State(ctypes.Structure):
    _fields_ = (("position", ctypes.c_double * 2), ("count", ctypes.c_int))


class Memory(Small):
    def prepare(self):
        self.state, self.queue = State(), array.array("d", [0.0, 1.0])
        self.position = np.ctypeslib.as_array(self.state.position)
        self.inside, self.values = np.frombuffer(self.state, np.uint8), np.frombuffer(self.queue)

    def advance(self):
        self.position += 1
        self.state.count += 1
        self.inside[16] += 1  # the lowest byte of the count
        self.values[1] += 1
        return self.state.position[1] + self.state.count + self.queue[1]


def test_views_of_ctypes_and_array():
    for target in assert_same_future(Memory):
        inner = target.unwrapped
        inner.state.position[0], inner.queue[0] = 5.0, 6.0
        assert inner.position[0] == 5 and inner.values[0] == 6 and inner.inside[:8].view(np.float64)[0] == 5


class Turning(Small):
    """SciPy's rotations keep an array in memory that Cython has made."""

    def prepare(self):
        self.rotation, self.by = Rotation.identity(), Rotation.from_euler("x", 0.1)

    def advance(self):
        self.rotation *= self.by
        return float(self.rotation.as_quat()[0])


def test_rotations():
    assert_same_future(Turning)
    env = Small()
    env.one = (Rotation.identity() * Rotation.identity())._quat
    env.other = np.asarray(env.one.base)
    with pytest.raises(SnapshotUnsupportedError, match=r"Small\.other cannot .*both are Cython's"):
        SnapshotEnvWrapper(env)
