"""Agents go on in a process that was forked after torch and the simulation had started threads."""

import subprocess
import sys

import pytest

#: Runs in a process of its own, as threads of the tests would be in the way.
SCRIPT = """
import multiprocessing, sys, warnings
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from sb3_mcbs import MCBSTD3, SearchPolicy, SnapshotEnvWrapper
from sb3_mcbs.models import ForwardModelError

th.set_num_threads(2)
env_id, search, workers = sys.argv[1], eval(sys.argv[2]), sys.argv[3] == "workers"
more = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork")) if workers else {}
env = make_vec_env(env_id, 2, seed=0, wrapper_class=SnapshotEnvWrapper, **more)
agent = MCBSTD3(
    "MlpPolicy", env, learning_starts=20, device="cpu", batch_size=256, buffer_size=500, seed=0,
    beam_width=4, rollout_depth=2, model_kwargs=dict(n_threads=2), **search,
)
agent.learn(60)
policy = SearchPolicy(agent, env, seed=0)

def go_on():
    try:
        agent.learn(60, reset_num_timesteps=False)
        policy.predict(env.reset())
    except ForwardModelError as error:
        print("refused:", error, flush=True)
        return
    assert (agent.num_timesteps, agent._n_updates) == (120, 50)
    print("child learned on", th.get_num_threads(), "thread", flush=True)

child = multiprocessing.get_context("fork").Process(target=go_on)
child.start()
child.join(60)
print("exit code", child.exitcode, flush=True)
if child.exitcode is None:
    child.kill()
agent.learn(20, reset_num_timesteps=False)
print("parent learned on", th.get_num_threads(), "threads")
env.close()
"""


def run(env_id: str, search: str, workers: str = "") -> tuple[str, str]:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, env_id, search, workers], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def case(env_id: str, search: str):
    return pytest.param(env_id, search, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    "env_id, search",
    [
        ("InvertedPendulum-v5", "{}"),
        case("InvertedPendulum-v5", "dict(fast_update=False)"),
        case("InvertedPendulum-v5", "dict(value_expansion=1)"),
        case("Pendulum-v1", "{}"),
    ],
)
def test_an_agent_learns_after_a_fork(env_id: str, search: str) -> None:
    out, err = run(env_id, search)
    assert "child learned on 1 thread\nexit code 0\nparent learned on 2 threads\n" in out
    assert err.count("torch computes on one thread here") == 1


@pytest.mark.slow
def test_workers_of_another_process_are_refused() -> None:
    out, _ = run("InvertedPendulum-v5", "{}", "workers")
    assert (
        "refused: the workers of this SubprocVecEnv belong to the process that this one was forked from"
        in out
    )
    assert "exit code 0\nparent learned on 2 threads\n" in out
