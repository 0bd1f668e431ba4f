"""Tables of text with aligned columns: Markdown for pages and files, plain lines for a terminal."""

from collections.abc import Sequence


def table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, words: int | None = None, markdown: bool = True
) -> str:
    """Rows below their head, each column as wide as its longest cell; no line feed after the last one.

    Args:
        head: titles of the columns.
        rows: one text for each column.
        words: how many columns, from the left, stand left; the others hold numbers and stand right. None: all.
        markdown: with bars and a rule below the head; otherwise two spaces between columns.
    """
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    words = len(widths) if words is None else words

    def line(cells: Sequence[str]) -> str:
        pairs = enumerate(zip(cells, widths, strict=True))
        aligned = [cell.ljust(width) if place < words else cell.rjust(width) for place, (cell, width) in pairs]
        return f"| {' | '.join(aligned)} |" if markdown else "  ".join(aligned).rstrip()

    rule = ["-" * width if place < words else "-" * (width - 1) + ":" for place, width in enumerate(widths)]
    return "\n".join(map(line, [head, *([rule] if markdown else []), *rows]))
