"""What an agent shows while it trains: TensorBoard's pages and the progress bar."""

import numpy as np
import pytest
from stable_baselines3.common.callbacks import CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from sb3_mcbs import MCBSSAC
from sb3_mcbs.agents import decision_log


def events_of(folder) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"histograms": 0})
    events.Reload()
    return events


def hparams_of(events: EventAccumulator) -> tuple[dict, set]:
    """The hyperparameters and the names of the metrics, as TensorBoard's HParams tab reads them."""
    found = {}
    for tag, content in events.summary_metadata.items():
        if content.plugin_data.plugin_name == "hparams":
            found[tag] = plugin_data_pb2.HParamsPluginData.FromString(content.plugin_data.content)
    session = found["_hparams_/session_start_info"].session_start_info.hparams
    values = {name: getattr(value, value.WhichOneof("kind")) for name, value in session.items()}
    return values, {each.name.tag for each in found["_hparams_/experiment"].experiment.metric_infos}


def test_tensorboard_shows_hyperparameters_returns_and_candidates(make_agent, tmp_path) -> None:
    agent = make_agent(
        cls=MCBSSAC,
        tensorboard_log=str(tmp_path),
        learning_starts=150,
        gradient_steps=0,
        search_kwargs=dict(antithetic=True),
    )
    callback = EvalCallback(make_vec_env("Pendulum-v1"), eval_freq=300, n_eval_episodes=1, verbose=0)
    agent.learn(400, callback=callback, log_interval=1)
    events = events_of(tmp_path / "MCBSSAC_1")
    values, metrics = hparams_of(events)
    assert values["algorithm"] == "MCBSSAC"
    assert values["beam_width"] == agent.beam_width
    assert values["antithetic"] == "True"
    assert values["gamma"] == pytest.approx(0.99)
    assert "noise_clip" not in values  # None
    assert {"eval/mean_reward", "eval_actor/mean_reward"} <= metrics
    assert "eval/mean_reward" in events.Tags()["scalars"]

    first, second = events.Histograms("search/candidate_values")
    assert (first.step, second.step) == (200, 400)
    # Fifty decisions in the first table, two hundred in the second, of each all candidates around 0.
    for event, n_decisions in ((first, 50), (second, 200)):
        assert event.histogram_value.num == n_decisions * agent.beam_width
        assert event.histogram_value.sum == pytest.approx(0, abs=1e-3)
        assert event.histogram_value.max > 0
    assert not agent.candidate_values


def test_other_outputs_get_numbers_only(make_agent, tmp_path, capsys) -> None:
    agent = make_agent(gradient_steps=0)
    agent.set_logger(configure(str(tmp_path), ["stdout", "csv", "json", "log"]))
    agent.learn(400, log_interval=1)
    assert "candidate_values" not in capsys.readouterr().out
    assert "candidate_values" not in (tmp_path / "progress.csv").read_text()
    assert not agent.candidate_values


def test_histograms_leave_out_what_is_not_finite(make_agent, tmp_path) -> None:
    agent = make_agent(tensorboard_log=str(tmp_path), gradient_steps=0)
    plan = agent.planner.plan

    def with_an_invalid_candidate(*args, **kwargs):
        result = plan(*args, **kwargs)
        result.values[0, 0] = np.nan
        return result

    agent.planner.plan = with_an_invalid_candidate
    agent.learn(220, log_interval=1)
    assert "search/candidate_values" not in events_of(tmp_path / "MCBSTD3_1").Tags()["histograms"]


@pytest.fixture
def bars(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The descriptions that progress bars had after each step."""
    described: list[str] = []
    on_step = decision_log.SearchProgressBarCallback._on_step

    def noted(self) -> bool:
        result = on_step(self)
        described.append(self.pbar.desc)
        return result

    monkeypatch.setattr(decision_log.SearchProgressBarCallback, "_on_step", noted)
    return described


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize("callback", [None, [], lambda *_: True])
def test_the_progress_bar_says_how_much_is_searched(make_agent, callback, bars) -> None:
    agent = make_agent(learning_starts=50)
    agent.learn(100, callback=callback, progress_bar=True)
    assert len(bars) == 100
    assert not any(bars[:49])
    share, milliseconds = bars[-1].removeprefix("search ").split(", ")
    # Warm-up counts as not searched.
    assert share == f"{agent.n_decisions / 100:.0%}" != "100%"
    assert float(milliseconds.removesuffix(" ms")) > 0
    agent.learn(20, progress_bar=True, reset_num_timesteps=False)
    assert bars[-1].startswith("search 100%, ")


def test_callbacks_are_called_beside_the_progress_bar(make_agent) -> None:
    calls: list[int] = []
    callback = decision_log.with_progress_bar(lambda *_: calls.append(1) or True)
    assert isinstance(callback, CallbackList)
    with pytest.warns(match="rich is experimental"):
        make_agent().learn(5, callback=callback)
    assert len(calls) == 5
