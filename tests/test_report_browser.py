"""A report in a browser: narrow and wide, light and dark."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from sb3_mcbs.experiments.report.command import report
from tests.report_helpers import add_run, evaluate, experiment, frozen

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
BROWSER = next((found for name in BROWSERS if (found := shutil.which(name))), None)
#: Writes into the title: widths of window and page, texts that are cut off or overlap, and colours.
PROBE = """<script>
addEventListener("load", () => {
  const wrong = [];
  for (const svg of document.querySelectorAll("figure svg")) {
    const edge = svg.getBoundingClientRect();
    const texts = [...svg.querySelectorAll("text")];
    const boxes = texts.map(text => [text.textContent, text.getBoundingClientRect()]);
    boxes.forEach(([name, box], index) => {
      if (box.left < edge.left - 1 || box.right > edge.right + 1) wrong.push(name + " is cut off");
      if (box.top < edge.top - 1 || box.bottom > edge.bottom + 1) wrong.push(name + " is cut off");
      for (const [other, its] of boxes.slice(index + 1)) {
        const across = Math.min(box.right, its.right) - Math.max(box.left, its.left);
        const down = Math.min(box.bottom, its.bottom) - Math.max(box.top, its.top);
        if (across > 1 && down > box.height / 3) wrong.push(name + " overlaps " + other);
      }
    });
  }
  const colour = (name, part) => getComputedStyle(document.querySelector(name))[part];
  document.title = JSON.stringify([innerWidth, document.documentElement.scrollWidth, wrong.join(),
    colour("body", "backgroundColor"), colour("svg", "color")]);
});
</script></body>"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        BROWSER is None, reason="needs Chromium, for example Debian's chromium-headless-shell"
    ),
]


@pytest.fixture(scope="module", params=["experiment", "frozen", "long names"])
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("pages") / "results"
    if request.param == "experiment":
        experiment(folder)
    elif request.param == "frozen":
        frozen(folder)
    else:
        for number in range(8):
            arm = f"mcbs_td3-with-a-name-that-says-all-of-it-{number}-beam_width=6-rollout_depth=3"
            evaluate(add_run(folder, arm, "HalfCheetah-v5", 0), [1e3, 2e4, 3e5], [1e3, 2e4, 3e5])
    report(folder, output=folder / "report")
    return (folder / "report" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("width", [400, 1400])
@pytest.mark.parametrize(("scheme", "ground", "ink"), [(1, 253, 27), (0, 20, 230)])
def test_nothing_is_cut_off(
    page: str, width: int, scheme: int, ground: int, ink: int, tmp_path: Path
) -> None:
    assert BROWSER is not None
    path = tmp_path / "page.html"
    path.write_text(page.replace("<details>", "<details open>").replace("</body>", PROBE), encoding="utf-8")
    words = [
        *(BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--dump-dom"),
        *(f"--window-size={width},900", f"--blink-settings=preferredColorScheme={scheme}", path.as_uri()),
    ]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=True)
    title = re.search(r"<title>(.*?)</title>", done.stdout)
    assert title is not None
    expected = rf'\[{width},{width},"","rgb\({ground}, .*","rgb\({ink}, .*"\]'
    assert re.fullmatch(expected, title[1]), title[1]
