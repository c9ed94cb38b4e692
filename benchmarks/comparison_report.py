"""What comparisons with an independent engine print: tables, and agreements that are checked."""

import sys


class Report:
    """Prints tables, keeps their numbers for the JSON file, and counts failed agreements."""

    def __init__(self):
        self.data, self.failed, self.passed = {}, [], 0

    def table(self, title: str, heads, rows) -> None:
        """Print rows under their heads as a table of Markdown and keep them."""
        self.data[title] = [dict(zip(heads, row)) for row in rows]
        print(f"\n{title}\n\n| " + " | ".join(heads) + " |\n|" + "---|" * len(heads))
        for row in rows:
            print("| " + " | ".join(_text(value) for value in row) + " |")
        sys.stdout.flush()

    def check(self, what: str, value: float, limit: float) -> None:
        """Check an agreement: `value` is at most `limit`."""
        good = bool(value <= limit)
        self.passed += good
        self.failed += [] if good else [what]
        self.data.setdefault("agreements", []).append(
            {"what": what, "value": float(value), "limit": limit, "met": good}
        )
        print(f"{'met ' if good else 'FAILED'} {what}: {value:.2g} (at most {limit:g})")


def _text(value) -> str:
    if value is None:
        return ""
    return f"{value:.7g}" if isinstance(value, float) else str(value)
