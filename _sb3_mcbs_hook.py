"""
Adds sb3-mcbs to RL Zoo when, and only when, RL Zoo is imported.

RL Zoo has no place where a package could register an algorithm, so a ``.pth`` line imports this module at
interpreter start. It therefore stands alone and imports nothing that the interpreter has not loaded already:
all it does is to put a finder that waits for RL Zoo's modules in front of ``sys.meta_path``.
Set the environment variable ``SB3_MCBS_NO_ZOO_HOOK=1`` to switch it off.
"""

import os
import sys

TYPE_CHECKING = False  # importing typing would take longer than all the rest of this module
if TYPE_CHECKING:
    from typing import Any

SWITCH = "SB3_MCBS_NO_ZOO_HOOK"
# The last one is ours: whoever imports it first imports rl_zoo3.exp_manager half-way through it, when the
# class that belongs into rl_zoo3.exp_manager does not exist yet.
WATCHED = ("rl_zoo3.utils", "rl_zoo3.hyperparams_opt", "rl_zoo3.exp_manager", "sb3_mcbs.zoo.manager")
# The command that says which library a failing renderer needs.
RECORD_VIDEO = "rl_zoo3.record_video"
# The system's library that MuJoCo draws pictures with, by the value of MUJOCO_GL.
LIBRARIES = {"osmesa": "libosmesa6", "egl": "libegl1"}


def _register(module: "Any") -> None:
    try:
        from sb3_mcbs.zoo import registration

        registration.after_import(module)
    except Exception as error:
        _warn(module.__name__, error)


def _warn(name: str, error: Exception) -> None:
    import warnings

    cause = f"{type(error).__name__}: {error}"
    failure = f"sb3-mcbs could not register its algorithms when {name} was imported ({cause})"
    backend = os.environ.get("MUJOCO_GL", "").strip().lower()
    # With a renderer that is not there, not even MuJoCo itself can be imported.
    if backend in LIBRARIES and "mujoco" not in sys.modules:
        advice = (
            f"MUJOCO_GL={backend} needs the system library {LIBRARIES[backend]}: install it, or unset "
            "MUJOCO_GL to do without pictures"
        )
    else:
        advice = "Repair the installation (pip install --force-reinstall 'sb3-mcbs[zoo]')"
    if _is_asked_for():
        raise SystemExit(f"{failure}. {advice}.")
    warnings.warn(
        f"{failure}. RL Zoo's own algorithms are not affected. {advice}, or set {SWITCH}=1 to silence this.",
        RuntimeWarning,
        stacklevel=3,
    )


def _is_asked_for() -> bool:
    """Whether the command line names one of our algorithms, which RL Zoo would call an invalid choice."""
    return "--algo mcbs_" in " ".join(getattr(sys, "argv", ())).replace("--algo=", "--algo ")


def name_missing_library(kind: "Any", error: BaseException, traceback: "Any") -> None:
    """
    Show an uncaught error; in place of a traceback through MuJoCo's renderer say what it needs.

    :param kind: class of the error
    :param error: the error
    :param traceback: where it came from
    """
    modules, step = [], traceback
    while step is not None:
        modules.append(step.tb_frame.f_globals.get("__name__"))
        step = step.tb_next
    if "gymnasium.envs.mujoco.mujoco_rendering" not in modules or not isinstance(error, Exception):
        sys.__excepthook__(kind, error, traceback)
        return
    backend = os.environ.get("MUJOCO_GL") or "unset"
    print(
        f"MuJoCo cannot draw pictures here ({kind.__name__}: {error}). MUJOCO_GL is {backend}. Without a "
        "display install the system library libosmesa6 and set MUJOCO_GL=osmesa, or libegl1 and "
        "MUJOCO_GL=egl.",
        file=sys.stderr,
    )


class ZooFinder:
    """Finds nothing by itself: lets the other finders find RL Zoo's modules and registers after these ran."""

    def find_spec(self, fullname: str, path: "Any" = None, target: "Any" = None) -> "Any":
        """
        :param fullname: name of the module that is being imported
        :param path: ``__path__`` of its package
        :param target: the module itself if it is being reloaded
        :return: the spec the other finders gave, or None for every module but the watched ones
        """
        if fullname not in WATCHED and fullname != RECORD_VIDEO:
            return None
        for finder in sys.meta_path:
            find_spec = getattr(finder, "find_spec", None)
            # By name: another copy of this module would ask this finder in turn, without an end.
            if type(finder).__name__ == "ZooFinder" or find_spec is None:
                continue
            spec = find_spec(fullname, path, target)
            if spec is not None:
                return _announcing(spec) if fullname in WATCHED else _naming_library(spec)
        return None


def _announcing(spec: "Any") -> "Any":
    loader = spec.loader
    execute = loader.exec_module

    def exec_module(module: "Any") -> None:
        execute(module)
        _register(module)

    # On the instance, so that the loader keeps its class and with it all that other tools ask of a loader.
    loader.exec_module = exec_module
    return spec


def _naming_library(spec: "Any") -> "Any":
    # ``python -m`` runs the command's code and imports nothing.
    get_code = spec.loader.get_code

    def get_code_and_name(name: str) -> "Any":
        sys.excepthook = name_missing_library
        return get_code(name)

    spec.loader.get_code = get_code_and_name
    return spec


def install() -> None:
    """Put the finder in place, once, unless the environment says no."""
    if os.environ.get(SWITCH, "0") not in ("", "0"):
        return
    if not any(type(finder).__name__ == "ZooFinder" for finder in sys.meta_path):
        sys.meta_path.insert(0, ZooFinder())


install()
