"""Writes the tables and curves of ``docs/results.md`` and ``docs/results/README.md``.

They are made from ``evaluations.csv``, which has every episode, and from ``screens.csv``, which has the means
of runs whose episodes were not kept. To add runs, replace ``evaluations.csv`` by the file of that name that
``sb3-mcbs report docs/results/evaluations.csv FOLDER -o NEW`` writes.
"""

from pathlib import Path
from typing import NamedTuple

import pandas as pd

from sb3_mcbs.experiments.report.curves import curve_pictures
from sb3_mcbs.experiments.report.references import published_curves
from sb3_mcbs.experiments.report.runs import Competitor
from sb3_mcbs.experiments.report.sources import load_results
from sb3_mcbs.experiments.report.statistics import first_at
from sb3_mcbs.zoo.evaluations import ACTOR, SEARCH, Evaluations, interquartile_mean

HERE = Path(__file__).resolve().parent
RUN, POLICIES = ["experiment", "environment", "arm", "seed"], [ACTOR, SEARCH]
#: A run's score is the mean of its evaluations from the first to the last of these steps.
SCORED = 45_000, 60_000
SCORE = "mean of 45,000 to 60,000"
#: The order of the rows.
ENVIRONMENTS = ["HalfCheetah-v5", "Walker2d-v5", "Hopper-v5", "Ant-v5"]
ARMS = ["td3", "mcbs_td3-paper", "mcbs_td3-stored", "mcbs_crossq", "no-search", "crossq", "crossq-n3"]
#: Arms of the pictures, and patterns of those in the tables.
CURVES = ["td3", "mcbs_td3-paper", "crossq", "no-search", "mcbs_crossq"]
ON_CROSSQ, ON_TD3 = "(?!td3|mcbs_td3|copies).*", "(td3|mcbs_td3).*"


class Table(NamedTuple):
    """Which runs are shown, at which steps.

    :param experiment: of the runs.
    :param steps: columns.
    :param arms: a pattern.
    :param others: whether the environments are those other than HalfCheetah, which have a column then.
    :param scored: whether there is a column of scores.
    """

    experiment: str
    steps: list[int]
    arms: str = ON_CROSSQ
    others: bool = False
    scored: bool = False


TABLES = {
    "protocol": Table("protocol", [15_000, 30_000, 45_000, 60_000, 100_000], scored=True),
    "copies": Table("protocol", [320_000 * n for n in (2, 3, 4, 6, 9, 12)], arms="copies"),
    "environments": Table("protocol", [20_000, 30_000, 45_000, 60_000, 80_000, 100_000], others=True),
    "screens": Table("screen", [10_000, 20_000, 30_000, 40_000], others=True),
    "screen": Table("screen", [10_000, 15_000, 30_000, 45_000, 60_000], scored=True),
    "td3": Table("screen", [15_000, 20_000, 25_000, 30_000], arms=ON_TD3),
    "on-td3": Table("protocol", [20_000, 40_000, 60_000, 80_000, 100_000, 200_000, 300_000], arms=ON_TD3),
}


def read() -> pd.DataFrame:
    """All evaluations, with their means and standard deviations."""
    rows = pd.read_csv(HERE / "evaluations.csv")
    returns = rows.filter(regex=r"^return_\d+$")
    rows["experiment"] = "protocol"
    rows["step"] = rows["timesteps"].round(-3)  # several environments step at once
    rows["mean"], rows["std"] = returns.mean(axis=1), returns.std(axis=1, ddof=0)
    return pd.concat([rows, pd.read_csv(HERE / "screens.csv")])


def cells(returns: pd.DataFrame) -> pd.Series:
    """Both policies' returns of each run, or nothing.

    :param returns: a column for each policy.
    """
    returns = returns.reindex(columns=POLICIES)
    joined = returns[POLICIES[0]].map("{:.0f}".format) + " / " + returns[POLICIES[1]].map("{:.0f}".format)
    return joined.where(returns.notna().all(axis=1), "")


def markdown(columns: pd.DataFrame) -> str:
    """A table in Markdown."""
    lines = [columns.columns, ["---"] * columns.shape[1], *columns.fillna("").to_numpy()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def returns_table(table: Table, data: pd.DataFrame) -> str:
    """Returns by steps.

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
    columns["last step"] = runs["step"].max().map("{:,.0f}".format)
    columns["simulated until then, millions"] = (runs["simulated_steps"].max() / 1e6).map("{:.2f}".format)
    columns = columns.reset_index().astype({"seed": str})
    if table.scored:
        columns = pd.concat([columns, summaries(scores)])
    columns["place"] = columns["arm"].map(lambda arm: ARMS.index(arm) if arm in ARMS else len(ARMS))
    columns["environment"] = pd.Categorical(columns["environment"], ENVIRONMENTS)
    columns = columns.sort_values(["environment", "place", "arm"], kind="stable").drop(columns="place")
    columns["environment"] = columns["environment"].astype(str).str.replace(r"-v\d", "", regex=True)
    columns["arm"] = columns["arm"].str.replace(r"^[^ ]+", r"`\g<0>`", regex=True)
    return markdown(columns if table.others else columns.drop(columns="environment"))


def scores_of(returns: pd.DataFrame) -> pd.DataFrame:
    """The scores of the runs that came far enough.

    :param returns: a row for each run, columns for each step and policy.
    """
    steps = returns.columns.get_level_values("step")
    complete = returns.reindex(columns=pd.MultiIndex.from_product([SCORED, POLICIES])).notna().all(axis=1)
    part = returns.loc[complete, (steps >= SCORED[0]) & (steps <= SCORED[1])]
    return part.T.groupby(level="policy").mean().T.reindex(returns.index)


def summaries(scores: pd.DataFrame) -> pd.DataFrame:
    """A row for each arm of which three runs or more have a score."""
    found = []
    for (environment, arm), part in scores.dropna().groupby(level=[0, 1]):
        if len(part) >= 3:  # of three nothing is trimmed
            what = "mean of 3" if len(part) == 3 else f"interquartile mean of {len(part)}"
            both = " / ".join(f"{interquartile_mean(part[policy].to_numpy()):.0f}" for policy in POLICIES)
            found.append((environment, arm, what, f"**{both}**"))
    return pd.DataFrame(found, columns=["environment", "arm", "seed", SCORE])


def reached_table() -> str:
    """When ``mcbs_crossq`` first returns what TD3's actor does after 300,000 steps."""
    results = load_results(HERE / "evaluations.csv")
    rows = []
    for run in sorted(results.runs, key=lambda run: ENVIRONMENTS.index(run.environment)):
        if run.arm != "mcbs_crossq":
            continue
        (zoo,) = [curve for curve in published_curves(run.environment) if curve.name == "RL Zoo TD3"]
        ours = [each.policies[ACTOR].means[-1] for each in results.of(run.task, Competitor("td3", ACTOR))]
        targets = {
            "RL Zoo's TD3": zoo.returns[zoo.steps == 300_000].item(),
            "our TD3": ours[0] if ours else None,
        }
        row = {"environment": run.environment.removesuffix("-v5"), "seed": str(run.seed)}
        for policy in POLICIES:
            for whose, target in targets.items():
                reached = first(run.policies[policy], target)
                row[f"{policy.replace('actor ', '')}: {whose}"] = reached
        rows.append(row)
    return markdown(pd.DataFrame(rows))


def first(evaluations: Evaluations, target: float | None) -> str:
    """Steps and minutes until the first evaluation that reaches a return.

    :param evaluations: of one policy of a run.
    :param target: the return; ``None``: nobody knows it.
    """
    if target is None:
        return "–"
    index = first_at(evaluations, target)
    if index is None:
        return f"not by {evaluations.timesteps[-1]:,.0f}"
    assert evaluations.seconds is not None
    return f"{evaluations.timesteps[index]:,.0f} ({evaluations.seconds[index] / 60:.0f} min)"


def with_tables(page: str, data: pd.DataFrame) -> str:
    """A page with the present tables between its markers."""
    texts = {name: returns_table(table, data) for name, table in TABLES.items()}
    texts["reached"] = reached_table()
    for name, text in texts.items():
        if f"<!-- {name} -->" in page:
            before, rest = page.split(f"<!-- {name} -->\n")
            _, after = rest.split(f"\n<!-- end of {name} -->")
            page = f"{before}<!-- {name} -->\n\n{text}\n\n<!-- end of {name} -->{after}"
    return page


#: Where tables stand.
PAGES = [HERE.parent / "results.md", HERE / "README.md"]


def main() -> None:
    """Rewrite the pages and the curves."""
    data = read()
    for page in PAGES:
        page.write_text(with_tables(page.read_text(), data))
    results = load_results(HERE / "evaluations.csv", arms=CURVES)
    for picture in curve_pictures(results, "HalfCheetah-v5"):
        (HERE / f"{picture.name}.png").write_bytes(picture.drawing.png)


if __name__ == "__main__":
    main()
