"""What ``-optimize`` has beyond RL Zoo's: several seeds per trial, kept agents, and studies on a server."""

import argparse
import random
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import optuna
from optuna.storages import BaseStorage, GrpcStorageProxy, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.study import MaxTrialsCallback
from optuna.trial import FrozenTrial, TrialState

from sb3_mcbs.zoo.evaluations import interquartile_mean

#: Names of the user attributes of trials.
RETURNS, SEEDS, OBJECTIVE, FOLDER = "returns", "seeds", "objective", "folder"
#: Seconds between two signs of life of a worker. A trial without one for twice as long has lost its worker.
HEARTBEAT = 60
#: A trial that lost its worker is tried again this often: it may be what kills them.
MAX_RETRIES = 3
#: Seconds to wait for a gRPC proxy.
PROXY_TIMEOUT = 20
PROXY = "grpc://"
#: Attempts, up to a second apart, to find a new database's tables complete.
TABLE_ATTEMPTS = 20


#: From the returns of episodes, what a trial is judged by.
OBJECTIVES: dict[str, Callable[[np.ndarray], float]] = {
    "mean": lambda returns: float(np.mean(returns)),
    "iqm": lambda returns: float(interquartile_mean(returns)),
}


def _at_least(least: int) -> Callable[[str], int]:
    def number(text: str) -> int:
        if not text.isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"must be a whole number of {least} or more, got {text!r}")
        return int(text)

    return number


class TrainParser(argparse.ArgumentParser):
    """
    RL Zoo's parser of training commands, with options of this package.

    The parameters are those of ``ArgumentParser``.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        group = self.add_argument_group("sb3-mcbs: hyperparameter optimization")
        group.add_argument(
            "--trial-seeds",
            type=_at_least(1),
            default=1,
            metavar="N",
            help="trainings per trial, one after another with different seeds (default: 1)",
        )
        group.add_argument(
            "--trial-objective",
            choices=tuple(OBJECTIVES),
            default="mean",
            help="mean or interquartile mean of the last evaluations' episodes of all seeds (default: mean)",
        )
        group.add_argument(
            "--keep-trials",
            type=_at_least(1),
            metavar="K",
            help="keep the agents of the K best trials in --optimization-log-path (default: of all trials)",
        )
        group.add_argument(
            "--heartbeat",
            type=_at_least(0),
            default=HEARTBEAT,
            metavar="SECONDS",
            help="seconds between a worker's signs of life in a database; a trial without one for twice as "
            f"long is given to another worker; 0: never (default: {HEARTBEAT})",
        )


def open_storage(url: str, heartbeat: int = 0) -> BaseStorage:
    """
    Open the storage of a study.

    :param url: a journal's file ``FILE.log``, a database's URL, or ``grpc://HOST:PORT`` of a gRPC proxy
    :param heartbeat: seconds between the signs of life of a worker in a database; 0: none
    :return: the storage
    :raises SystemExit: if it cannot be opened
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        if url.endswith(".log"):
            storage: Any = JournalStorage(JournalFileBackend(url))
        elif url.startswith(PROXY):
            storage = _open_proxy(url)
        else:
            storage = _open_database(url, heartbeat)
    # RL Zoo asks the storage's name whether it is a journal's, and takes anything else as it is.
    storage.endswith = "".endswith
    return storage


def _open_proxy(url: str) -> GrpcStorageProxy:
    try:
        address = urlsplit(url)
        host, port = address.hostname, address.port
    except ValueError:
        host = port = None
    if not host or not port:
        sys.exit(f"--storage {url}: write {PROXY}HOST:PORT.")
    try:
        storage = GrpcStorageProxy(host=host, port=port)
        storage.wait_server_ready(timeout=PROXY_TIMEOUT)
    except ImportError as error:
        sys.exit(f'--storage {url}: {error}. Install sb3-mcbs with "[tuning]".')
    except ConnectionError:
        sys.exit(
            f"--storage {url}: no answer within {PROXY_TIMEOUT} seconds. Start the proxy with "
            "optuna.storages.run_grpc_proxy_server, or correct the address."
        )
    return storage


def _open_database(url: str, heartbeat: int) -> RDBStorage:
    from sqlalchemy.exc import ArgumentError, DBAPIError

    options: dict[str, Any] = {}
    if heartbeat:
        retry = optuna.storages.RetryHeartbeatStaleTrialCallback(max_retry=MAX_RETRIES)
        options = dict(heartbeat_interval=heartbeat, heartbeat_stale_trial_callback=retry)
    # A trial takes long: its connection may be closed by then.
    options["engine_kwargs"] = {"pool_pre_ping": True}
    try:
        return _with_tables(lambda: RDBStorage(url, **options))
    except ImportError as error:
        sys.exit(
            f"--storage needs a database driver that is not installed ({error.__cause__ or error}). For "
            'PostgreSQL install sb3-mcbs with "[tuning]" and write postgresql+psycopg://USER@HOST:PORT/DATABASE.'
        )
    except ArgumentError as error:
        sys.exit(
            f"--storage names no storage ({error}). Write FILE.log, "
            f"postgresql+psycopg://USER@HOST:PORT/DATABASE, sqlite:///FILE.db or {PROXY}HOST:PORT."
        )
    except DBAPIError as error:
        reason = str(error.orig).splitlines()[0]
        sys.exit(f"--storage cannot be opened ({reason}). Start the server, or correct the URL.")


def _with_tables(connect: Callable[[], RDBStorage]) -> RDBStorage:
    """Connect again while another worker, started at the same time, creates the database's tables."""
    from sqlalchemy.exc import DBAPIError, IntegrityError

    for _ in range(TABLE_ATTEMPTS):
        try:
            return connect()
        except DBAPIError as error:
            if not isinstance(error, IntegrityError) and "already exists" not in str(error.orig):
                raise
            time.sleep(random.random())  # workers that failed together should not meet again
    return connect()


def join_study(storage: BaseStorage, name: str, settings: dict[str, Any]) -> None:
    """
    Create a study or join it, and let its trials whose workers have died be tried again.

    :param storage: an opened storage
    :param name: the study's name
    :param settings: what all workers of the study must agree on, by option name
    :raises SystemExit: if they do not
    """
    study = optuna.create_study(storage=storage, study_name=name, direction="maximize", load_if_exists=True)
    for option, value in settings.items():
        known = study.user_attrs.get(option)
        if known is None:
            study.set_user_attr(option, value)
        elif known != value:
            sys.exit(
                f"The study {name} has --{option} {known}, not {value}. All its workers need the same: "
                "join it with that, or use another --study-name."
            )
    _free_lost_trials(study)


def _free_lost_trials(study: optuna.Study) -> None:
    """Let trials fail whose workers have died, and queue them again. Optuna does so before each trial."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        optuna.storages.fail_stale_trials(study)


class TotalTrialsCallback(MaxTrialsCallback):
    """
    Ends a worker once the study has all its trials.

    With heartbeats it waits for the last trials of others: one may lose its worker and be queued again.

    The parameters are those of Optuna's ``MaxTrialsCallback``.
    """

    def __call__(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """
        :param study: the study
        :param trial: the trial that has ended
        """
        heartbeat = getattr(study._storage, "get_heartbeat_interval", lambda: None)()
        said = None
        while heartbeat and len(study.get_trials(deepcopy=False, states=self._states)) >= self._n_trials:
            running = [t.number for t in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))]
            if not running:
                break
            if running != said:
                print(f"Waiting for other workers' trials {running}, should one be killed.")
                said = running
            time.sleep(heartbeat)
            _free_lost_trials(study)
        super().__call__(study, trial)


def delete_agents(study: optuna.Study, folder: str, n_kept: int) -> None:
    """
    Delete the folders of finished trials that are not among the best.

    :param study: the study
    :param folder: the folder of all trials' folders
    :param n_kept: number of the best trials
    """
    finished = [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]
    complete = [trial for trial in finished if trial.state == TrialState.COMPLETE]
    best = sorted(complete, key=lambda trial: trial.value or 0.0, reverse=True)[:n_kept]
    kept = {trial.number for trial in best}
    for trial in finished:
        path = trial_folder(folder, trial.number)
        # Another study's trial may have the same number.
        if trial.number not in kept and trial.user_attrs.get(FOLDER) == path:
            shutil.rmtree(path, ignore_errors=True)


def trial_folder(folder: str, number: int) -> str:
    """
    :param folder: the folder of all trials' folders
    :param number: the trial's number
    :return: where RL Zoo writes the trial's agents and evaluations
    """
    return str(Path(folder).resolve() / f"trial_{number}")
