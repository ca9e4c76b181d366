"""Set reports side by side."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from trilitenet.commands.evaluate import check_counts, check_output
from trilitenet.commands.paths import StrPath, optional_path
from trilitenet.engine.compare import Comparison, compare_reports
from trilitenet.engine.report import Report, read_report
from trilitenet.errors import ConfigError

__all__ = ["compare"]


def compare(
    *reports: StrPath,
    published: bool = False,
    output: StrPath | None = None,
    overwrite: bool = False,
    resamples: int = 1000,
) -> Comparison:
    """Compare reports with the first of them: which differences are real.

    Args:
        reports: report.json files of `trilitenet evaluate` or `trilitenet score`, or the folders that hold them.
        published: Add the rows of the paper's tables, each marked with how it was measured.
        output: Folder to write comparison.json and comparison.html to.
        overwrite: Replace a comparison that is there.
        resamples: Bootstrap draws of the images, the same for every model; 0 for none.

    Returns:
        The comparison.

    Raises:
        ConfigError: If there is no report, or one is given twice.
        OutputError: If the output holds a comparison, or cannot be written.
    """
    if not reports:
        raise ConfigError("give at least one report.json, or a folder that holds one")
    check_counts(resamples)
    output = optional_path(output)
    check_output(output, overwrite, "comparison")
    paths = list(map(Path, reports))
    files = [path / "report.json" if path.is_dir() else path for path in paths]
    repeated = [path for path, count in Counter(file.resolve() for file in files).items() if count > 1]
    if repeated:
        raise ConfigError(f"{repeated[0]}: given more than once; give each report once")
    named: dict[str, Report] = {}
    for path, file in zip(paths, files, strict=True):
        report = read_report(file)
        name = Path(report.provenance.model).name or report.provenance.model
        if name in named:
            name = f"{name} ({path})"
        named[name] = report
    comparison = compare_reports(named, published=published, resamples=resamples)
    if output is not None:
        comparison.save(output)
    return comparison
