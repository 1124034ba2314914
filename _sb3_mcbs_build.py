"""
What a plain list of packages cannot say to setuptools.

A ``.pth`` file belongs next to the package, in the root of site-packages, for a normal and for an editable
installation; the hyperparameter files stand in the repository's root and travel inside the package.
"""

import base64
import hashlib
import shutil
import zipfile
from pathlib import Path

from setuptools.command.build_py import build_py
from setuptools.command.editable_wheel import editable_wheel

PTH_NAME = "_sb3_mcbs_hook.pth"
# One line, as a .pth file wants it. Whatever goes wrong (an editable checkout that was moved away, for one)
# must not show up at the start of every interpreter.
PTH_LINE = 'import os; exec("try:\\n    import _sb3_mcbs_hook\\nexcept Exception:\\n    pass")\n'

ROOT = Path(__file__).resolve().parent


class BuildPy(build_py):
    """Adds the ``.pth`` file and ``sb3_mcbs/hyperparams/`` to what a wheel is made of."""

    def run(self) -> None:
        """Build the packages, then add our files; an editable build takes nothing from the build folder."""
        super().run()
        if self.editable_mode:
            return
        for target in self._extra_files():
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.name == PTH_NAME:
                target.write_text(PTH_LINE)
            else:
                shutil.copyfile(ROOT / "hyperparams" / target.name, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        """
        :param include_bytecode: whether to list the compiled files as well
        :return: every file this command makes
        """
        outputs: list[str] = super().get_outputs(include_bytecode)
        return outputs if self.editable_mode else [*outputs, *map(str, self._extra_files())]

    def _extra_files(self) -> list[Path]:
        build_lib = Path(self.build_lib)
        names = sorted(path.name for path in (ROOT / "hyperparams").glob("*.yml"))
        return [build_lib / PTH_NAME, *(build_lib / "sb3_mcbs" / "hyperparams" / name for name in names)]


class EditableWheel(editable_wheel):
    """Adds the ``.pth`` file to the wheel that ``pip install -e`` installs."""

    def run(self) -> None:
        """Let setuptools make the wheel, then write it again with our file in its root."""
        folder = Path(self.dist_dir)
        before = {path: path.stat().st_mtime_ns for path in folder.glob("*.whl")}
        super().run()
        for path in folder.glob("*.whl"):
            if before.get(path) != path.stat().st_mtime_ns:
                add_to_wheel(path, {PTH_NAME: PTH_LINE.encode()})


def add_to_wheel(path: Path, files: dict[str, bytes]) -> None:
    """
    Add files to the root of a wheel.

    :param path: a wheel without these files, replaced in place
    :param files: content by name
    """
    partial = path.with_suffix(".partial")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as new:
        for item in old.infolist():
            content = old.read(item)
            if item.filename.endswith(".dist-info/RECORD"):
                for name, data in files.items():
                    new.writestr(name, data)
                    content += _record_line(name, data)
            new.writestr(item, content)
    partial.replace(path)


def _record_line(name: str, data: bytes) -> bytes:
    digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
    return f"{name},sha256={digest},{len(data)}\n".encode()
