"""Writes the tables of ``docs/results.md`` between its markers, from ``crossq.csv``.

``python docs/results/tables.py [EVALUATIONS.CSV ...]`` first adds files of that name that ``sb3-mcbs report``
wrote, in the place of earlier evaluations of the same runs.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from scipy.stats import trim_mean

HERE = Path(__file__).resolve().parent
CSV, PAGE = HERE / "crossq.csv", HERE.parent / "results.md"
RUN, POLICIES = ["experiment", "environment", "arm", "seed"], ["actor alone", "actor with search"]
#: A run's score is the mean of its evaluations from the first to the last of these steps.
SCORED = 45_000, 60_000
SCORE = "mean of 45,000 to 60,000"
#: The order of the rows.
ENVIRONMENTS = ["HalfCheetah-v5", "Walker2d-v5", "Hopper-v5", "Ant-v5"]
ARMS = ["mcbs_crossq", "no-search", "crossq", "crossq-n3", "crossq-delay-1", "crossq-1024"]


class Table(NamedTuple):
    """Which runs are shown, at which steps.

    :param experiment: of the runs.
    :param steps: columns.
    :param arms: a pattern, where only some are shown.
    :param others: whether the environments are those other than HalfCheetah, which have a column then.
    :param scored: whether there is a column of scores.
    """

    experiment: str
    steps: list[int]
    arms: str = ".*"
    others: bool = False
    scored: bool = False


TABLES = {
    "protocol": Table("protocol", [15_000, 30_000, 45_000, 60_000, 100_000], scored=True),
    "environments": Table("protocol", [20_000, 30_000, 45_000, 60_000, 80_000, 100_000], others=True),
    "screens": Table("screen", [10_000, 20_000, 30_000, 40_000], others=True),
    "screen": Table("screen", [10_000, 15_000, 30_000, 45_000, 60_000], arms="(?!mcbs_td3).*", scored=True),
    "td3": Table("screen", [15_000, 20_000, 25_000, 30_000], arms="mcbs_td3.*"),
}


def read_report(path: str) -> pd.DataFrame:
    """Read the ``evaluations.csv`` of a report, as rows of ``crossq.csv``."""
    rows = pd.read_csv(path)
    returns = rows.filter(regex=r"^return_\d+$")
    found = rows["run"].str.extract(r"(?P<arm>.+)_(?P<environment>.+)_(?P<seed>\d+)").astype({"seed": int})
    found["experiment"], found["policy"] = "protocol", rows["policy"]
    found["step"] = rows["timesteps"].round(-3)  # several environments step at once
    found["mean"], found["std"] = returns.mean(axis=1).round(1), returns.std(axis=1, ddof=0).round(1)
    found["episodes"], found["simulated_steps"] = returns.count(axis=1), rows["simulated_steps"]
    return found


def cells(returns: pd.DataFrame) -> pd.Series:
    """Both policies' returns of each run, or nothing.

    :param returns: a column for each policy.
    """
    returns = returns.reindex(columns=POLICIES)
    joined = returns[POLICIES[0]].map("{:.0f}".format) + " / " + returns[POLICIES[1]].map("{:.0f}".format)
    return joined.where(returns.notna().all(axis=1), "")


def rows_of(table: Table, data: pd.DataFrame) -> str:
    """A table in Markdown.

    :param table: what it shows.
    :param data: all evaluations.
    """
    other = data["environment"] != "HalfCheetah-v5"
    shown = (data["experiment"] == table.experiment) & (other == table.others)
    part = data[shown & data["arm"].str.fullmatch(table.arms)]
    runs = part.groupby(RUN[1:])
    returns = part.pivot(index=RUN[1:], columns=["step", "policy"], values="mean")
    columns = pd.DataFrame({f"{step:,}": cells(returns.get(step, returns[[]])) for step in table.steps})
    scores = scores_of(returns)
    if table.scored:
        columns[SCORE] = cells(scores)
    columns["simulated steps, millions"] = (runs["simulated_steps"].max() / 1e6).map("{:.2f}".format)
    columns = columns.reset_index().astype({"seed": str})
    if table.scored:
        columns = pd.concat([columns, summaries(scores)])
    columns["place"] = columns["arm"].map(lambda arm: ARMS.index(arm) if arm in ARMS else len(ARMS))
    columns["environment"] = pd.Categorical(columns["environment"], ENVIRONMENTS)
    columns = columns.sort_values(["environment", "place", "arm"], kind="stable").drop(columns="place")
    columns["environment"] = columns["environment"].astype(str).str.replace(r"-v\d", "", regex=True)
    columns["arm"] = columns["arm"].str.replace(r"^[^ ]+", r"`\g<0>`", regex=True)
    lines = [columns.columns, ["---"] * columns.shape[1], *columns.fillna("").to_numpy()]
    return "\n".join(f"| {' | '.join(line if table.others else line[1:])} |" for line in lines)


def scores_of(returns: pd.DataFrame) -> pd.DataFrame:
    """The scores of the runs that came far enough.

    :param returns: a row for each run, columns for each step and policy.
    """
    steps = returns.columns.get_level_values("step")
    complete = returns.reindex(columns=pd.MultiIndex.from_product([SCORED, POLICIES])).notna().all(axis=1)
    part = returns.loc[complete, (steps >= SCORED[0]) & (steps <= SCORED[1])]
    return part.T.groupby(level="policy").mean().T.reindex(returns.index)


def summaries(scores: pd.DataFrame) -> pd.DataFrame:
    """A row for each arm of which four runs or more have a score."""
    found = []
    for (environment, arm), part in scores.dropna().groupby(level=[0, 1]):
        if len(part) >= 4:
            both = " / ".join(f"{trim_mean(part[policy], 0.25):.0f}" for policy in POLICIES)
            found.append((environment, arm, f"interquartile mean of {len(part)}", f"**{both}**"))
    return pd.DataFrame(found, columns=["environment", "arm", "seed", SCORE])


def with_tables(page: str, data: pd.DataFrame) -> str:
    """A page with the present tables between its markers."""
    for name, table in TABLES.items():
        before, rest = page.split(f"<!-- {name} -->\n")
        _, after = rest.split(f"\n<!-- end of {name} -->")
        page = f"{before}<!-- {name} -->\n\n{rows_of(table, data)}\n\n<!-- end of {name} -->{after}"
    return page


def main(reports: list[str]) -> None:
    """Add reports to the CSV file, and rewrite the page."""
    data = pd.concat([pd.read_csv(CSV), *map(read_report, reports)])
    key = [*RUN, "policy", "step"]
    data = data.drop_duplicates(key, keep="last").sort_values(key)
    data.to_csv(CSV, index=False)
    PAGE.write_text(with_tables(PAGE.read_text(), data))


if __name__ == "__main__":
    main(sys.argv[1:])
