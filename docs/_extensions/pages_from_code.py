"""Directives whose content is made from the package: its public names, the keys of study files, the metrics, the
command's help, the reference data of the validation."""

import json
from pathlib import Path

from docutils import nodes
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

import rfem_jax

LOG = logging.getLogger(__name__)
REFERENCES = Path(rfem_jax.__file__).parent / "validation" / "references"


def setup(app):
    for name, kind in (
        ("public-names", PublicNames),
        ("study-keys", StudyKeys),
        ("study-metrics", StudyMetrics),
        ("command-help", CommandHelp),
        ("reference-data", ReferenceData),
    ):
        app.add_directive(name, kind)
    app.connect("env-purge-doc", lambda app, env, page: _shown(env).pop(page, None))
    app.connect("env-merge-info", lambda app, env, pages, other: _shown(env).update(_shown(other)))
    app.connect("env-check-consistency", _every_name_is_shown)
    return {"parallel_read_safe": True, "env_version": 1}


def _shown(env) -> dict[str, list[str]]:
    """Public names by the page that shows them."""
    if not hasattr(env, "rfem_jax_names"):
        env.rfem_jax_names = {}
    return env.rfem_jax_names


def _every_name_is_shown(app, env):
    shown = [name for names in _shown(env).values() for name in names]
    for name in rfem_jax.__all__:
        if shown.count(name) != 1:
            LOG.warning("rfem_jax.%s is on %d pages of the reference; it must be on one", name, shown.count(name))


def cell(text: str) -> str:
    """A cell of a Markdown table that shows a text as it is."""
    for sign in ("\\", "|", "<", "*", "[", "]", "`", "$", "_"):
        text = text.replace(sign, "\\" + sign)
    return text


class PublicNames(SphinxDirective):
    """The docstrings of the names in its body, each a heading's worth."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        names = " ".join(self.content).split()
        _shown(self.env)[self.env.docname] = [*_shown(self.env).get(self.env.docname, []), *names]
        found: list[nodes.Node] = []
        for name in names:
            value = getattr(rfem_jax, name)
            kind = "class" if isinstance(value, type) else "function" if callable(value) else "data"
            members = ["   :members:"] if kind == "class" and not issubclass(value, Exception) else []
            lines = ["```{eval-rst}", f".. auto{kind}:: rfem_jax.{name}", *members, "```"]
            found += self.parse_text_to_nodes("\n".join(lines))
        return found


class StudyKeys(SphinxDirective):
    """All tables of a study file with their keys."""

    def run(self) -> list[nodes.Node]:
        from rfem_jax.description.study_file.key_reference import key_tables

        found: list[nodes.Node] = []
        for table in key_tables():
            section = nodes.section(ids=[nodes.make_id(table.header)], names=[nodes.fully_normalize_name(table.header)])
            section += nodes.title(table.header, table.header)
            rows = ["| key | without it | meaning |", "|---|---|---|"]
            rows += [f"| `{key.name}` | {cell(key.default)} | {cell(key.meaning)} |" for key in table.keys]
            section += self.parse_text_to_nodes("\n".join(rows))
            found.append(section)
        return found


class StudyMetrics(SphinxDirective):
    """All metrics with their units, what they mean, what has them, and their equations."""

    def run(self) -> list[nodes.Node]:
        from rfem_jax.description.metrics.reference import metric_tables

        found: list[nodes.Node] = []
        for table in metric_tables():
            section = nodes.section(ids=[nodes.make_id(table.header)], names=[nodes.fully_normalize_name(table.header)])
            section += nodes.title(table.header, table.header[:1].upper() + table.header[1:])
            section += self.parse_text_to_nodes("\n".join(metric_lines(table.rows)))
            found.append(section)
        return found


def metric_lines(rows) -> list[str]:
    """A Markdown table of metrics."""
    lines = ["| metric | unit | meaning | what has it | theory |", "|---|---|---|---|---|"]
    for row in rows:
        texts = (row.unit or "1", row.meaning, row.needs or "all", row.equation or "-")
        lines.append(f"| `{row.name}` | {' | '.join(map(cell, texts))} |")
    return lines


class CommandHelp(SphinxDirective):
    """What `rfem-jax COMMAND --help` says, for all commands."""

    def run(self) -> list[nodes.Node]:
        import argparse

        from rfem_jax.report.command_line import build_parser

        parser = build_parser()
        commands = next(one for one in parser._actions if isinstance(one, argparse._SubParsersAction)).choices
        found: list[nodes.Node] = []
        for name, one in commands.items():
            one.formatter_class = lambda prog: argparse.HelpFormatter(prog, width=100)
            section = nodes.section(ids=[f"command-{name}"], names=[f"command {name}"])
            section += nodes.title(name, name)
            section += nodes.literal_block(one.format_help(), one.format_help(), language="none")
            found.append(section)
        return found


class ReferenceData(SphinxDirective):
    """The published numbers that validation compares with."""

    def run(self) -> list[nodes.Node]:
        rows = ["| problem | source | quantities | numbers |", "|---|---|---|---|"]
        for path in sorted(REFERENCES.glob("*.json")):
            data = json.loads(path.read_text(encoding="utf-8"))
            quantities = data["quantities"]
            words = "; ".join(f"{one.get('description', name)}, {one['unit']}" for name, one in quantities.items())
            count = sum(_count(one["values"]) for one in quantities.values())
            rows.append(f"| {cell(data['title'])} | {cell(_text(data['source']))} | {cell(words)} | {count} |")
        return self.parse_text_to_nodes("\n".join(rows))


def _text(value: object) -> str:
    return "; ".join(map(str, value)) if isinstance(value, list) else str(value)


def _count(value: object) -> int:
    if isinstance(value, dict):
        return sum(map(_count, value.values()))
    return sum(map(_count, value)) if isinstance(value, list) else 1
