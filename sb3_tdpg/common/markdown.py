"""Write Markdown: tables, and pages from templates."""

import re
from collections.abc import Sequence
from typing import Any

_MARKS = dict(l="---", r="---:", c=":---:")


def markdown_table(
    rows: Any, columns: Sequence[str] | None = None, *, digits: int = 3, align: str | None = None
) -> str:
    """
    Write a Markdown table.

    :param rows: A ``DataFrame`` (its index is left out), a list of dicts, or a list of lists together with ``columns``.
    :param columns: Header of the table; default: the names in ``rows``.
    :param digits: Number of decimals of a float. ``NaN`` and ``None`` become empty cells.
    :param align: ``"l"``, ``"r"`` or ``"c"`` for each column; the last letter applies to the remaining columns.
        Default: numbers are right-aligned, everything else is left-aligned.
    """
    # pandas is imported here, since its import takes most of a second and a training writes no table.
    import pandas as pd
    from pandas.api.types import is_bool_dtype, is_numeric_dtype

    frame = pd.DataFrame(rows, columns=None if columns is None else list(columns))
    if align is None:
        align = "".join("r" if is_numeric_dtype(t) and not is_bool_dtype(t) else "l" for t in frame.dtypes)
    marks = [_MARKS[letter] for letter in align.ljust(frame.shape[1], align[-1:])]

    def cell(value: Any) -> str:
        if value is None or value != value:  # NaN
            return ""
        text = f"{value:.{digits}f}" if isinstance(value, float) else str(value)
        return text.replace("|", r"\|")

    lines = [[cell(name) for name in frame.columns], marks]
    lines += [[cell(value) for value in row] for row in frame.itertuples(index=False, name=None)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def fill_template(package: str, template: str, **values: Any) -> str:
    """Fill a template from a package's folder ``templates/``; successive empty lines become one."""
    try:
        from jinja2 import Environment, PackageLoader
    except ImportError as e:
        raise ImportError("pages of results need jinja2: pip install sb3_tdpg[plots]") from e
    env = Environment(loader=PackageLoader(package), trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    env.filters.update(md=escaped, repr=repr)
    return re.sub(r"\n{3,}", "\n\n", env.get_template(template).render(**values)).lstrip()


def escaped(name: str) -> str:
    """Escape Markdown syntax in a name that a user has chosen."""
    return re.sub(r"([\\`*\[\]<>]|(?<!\w)_|_(?!\w))", r"\\\1", name)
