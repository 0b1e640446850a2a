"""Draw the figures and write the generated parts of ``docs/results.md``: ``make results``."""

import re

import claims
import figures
import table


def overall(found: list[claims.Finding]) -> str:
    """Return one verdict for all comparisons of a claim."""
    words = {finding.verdict for finding in found}
    if {"yes", "no"} <= words:
        return "mixed"
    word = next((word for word in ("yes", "no") if word in words), "undecided")
    return word if words == {word} else f"{word}, where decided"


def policy_line(policy: str, found: list[claims.Finding]) -> str:
    """Return how many comparisons of a policy have which verdict, the range of differences and the training seeds."""
    counts = []
    for word in dict.fromkeys(("yes", "no", "undecided", *(finding.verdict for finding in found))):
        these = [finding for finding in found if finding.verdict == word]
        single = sum(1 in finding.seeds for finding in these) if word in ("yes", "no") else 0
        counts += [f"{len(these)} {word}" + f" ({single} one-seed)" * bool(single)] if these else []
    means = [finding.mean for finding in found if finding.seeds]
    seeds = [count for finding in found for count in finding.seeds]
    if not means:
        return f"{policy}: {', '.join(counts)}"
    ends = "..".join(dict.fromkeys(f"{mean:+.4f}" for mean in (min(means), max(means))))
    return f"{policy}: {', '.join(counts)}; {ends}; {'-'.join(map(str, sorted({min(seeds), max(seeds)})))}"


def claims_table(results: dict, differences: dict, beyond: bool) -> list[str]:
    """Return the lines of the table of claims."""
    lines = ["| claim | verdict | comparisons; differences; seeds | remark |", "|---|---|---|---|"]
    for claim in claims.read():
        if claim.get("beyond_the_paper", False) is beyond:
            found = {
                policy: [claims.judge(comparison, results, differences) for comparison in comparisons]
                for policy, comparisons in claim["policies"].items()
            }
            word = overall(sum(found.values(), []))
            parts = "<br>".join(policy_line(policy, part) for policy, part in found.items())
            lines.append(f"| {claim['claim']} ({claim['measured']}) | **{word}** | {parts} | {claim['remark']} |")
    return lines


def occupancy_table(columns: list[str], rows: dict[str, str], results: dict, given: dict | None = None) -> list[str]:
    """Return the lines of a table of mean occupancies: cells in whose names ``{}`` stands for the column."""
    lines = [f"| method | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for name, values in (given or {}).items():
        lines.append(f"| {name} | {' | '.join(f'{value:.4f}' for value in values)} |")
    for method, name in rows.items():
        found = [figures.pooled([name.format(column)], results) for column in columns]
        marks = [cell and "°" * (cell["episodes"] < claims.FEW) + "†" * cell["untrained"] for cell in found]
        values = [f"{cell['mean']:.4f}{mark}" if cell else "" for cell, mark in zip(found, marks, strict=True)]
        k = name.partition("-K")[2]
        lines.append(f"| {figures.STYLE[method][0]}{f', K={k}' if k else ''} | {' | '.join(values)} |")
    return lines


def main() -> None:
    results, differences = table.read("results"), table.read("differences")
    for name in figures.FIGURES:
        figures.draw(name, results, table.read("learning_curves").values(), table.RESULTS / f"{name}.png")
    parts = {
        "claims": claims_table(results, differences, beyond=False),
        "beyond": claims_table(results, differences, beyond=True),
        **{name: occupancy_table(**rows, results=results) for name, rows in figures.TABLES.items()},
    }
    text = (path := table.RESULTS.parent / "results.md").read_text()
    for name, lines in parts.items():
        pattern = re.compile(rf"(<!-- {name}: [^\n]*-->\n).*?(<!-- end -->)", re.DOTALL)
        text = pattern.sub(lambda found, lines=lines: "\n".join([found[1], *lines, "", found[2]]), text)
    path.write_text(text)


if __name__ == "__main__":
    main()
