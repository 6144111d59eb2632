"""What there is to mutate, and every mutant of it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("can_dbc", "controller")


class Mutant(NamedTuple):
    """One change: place, lines before and after, the whole module; `function`: the outermost one around it, or empty."""

    module: str
    place: str
    function: str
    first: int
    last: int
    was: str
    becomes: str
    code: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What the list of survivors knows it by."""
        return f"{self.module}: {self.place}", self.was, self.becomes


def modules() -> dict[str, Path]:
    """Every module of both packages with its file."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def dependants(module: str) -> set[str]:
    """Modules of both packages that import a module, directly or not, itself included."""
    imports: dict[str, set[str]] = {}
    for name, path in modules().items():
        imports[name] = found = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    found = {module}
    while more := {name for name, used in imports.items() if used & found} - found:
        found |= more
    return found


def mutants(module: str, path: Path) -> Iterator[Mutant]:
    """All mutants of a module, in the order of its lines."""
    import libcst as cst
    from libcst.metadata import MetadataWrapper, PositionProvider
    from mutmut.mutation.file_mutation import MutationVisitor, deep_replace
    from mutmut.mutation.mutators import mutation_operators
    from mutmut.mutation.pragma_handling import IgnoredCode

    class Visitor(MutationVisitor):
        def __init__(self) -> None:
            super().__init__(mutation_operators, IgnoredCode(set(), set(), set()))
            self.spans: list[tuple[int, int]] = []

        def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
            decorated = isinstance(node, cst.FunctionDef)  # which mutmut's trampolines cannot do
            return not decorated and super()._skip_node_and_children(node)

        def _create_mutations(self, node: cst.CSTNode) -> None:
            super()._create_mutations(node)
            at = self.get_metadata(PositionProvider, node, None)
            span = (at.start.line, at.end.line) if at else self.spans[-1]
            self.spans += [span] * (len(self.mutations) - len(self.spans))

    source = path.read_text(encoding="utf-8")
    visitor = Visitor()
    tree = MetadataWrapper(cst.parse_module(source)).visit(visitor)
    # only the statement that changes is written anew
    parts = [tree.code_for_node(statement) for statement in tree.body]
    header = "".join(tree.code_for_node(line) for line in tree.header)
    footer = "".join(tree.code_for_node(line) for line in tree.footer)
    assert header + "".join(parts) + footer == source, path
    ends = [header.count("\n")]
    for part in parts:
        ends.append(ends[-1] + part.count("\n"))
    places, functions = {}, {}
    for name, lines, outermost in _functions(source):
        places.update(dict.fromkeys(lines, name))
        if outermost:
            functions.update(dict.fromkeys(lines, name))
    old = source.splitlines()
    for mutation, (first, last) in zip(visitor.mutations, visitor.spans, strict=True):
        number = next(i for i, end in enumerate(ends[1:]) if first <= end)
        changed = deep_replace(tree.body[number], mutation.original_node, mutation.mutated_node)
        code = "".join(
            (header, *parts[:number], tree.code_for_node(changed), *parts[number + 1 :], footer)
        )
        new = code.splitlines()
        if new == old:
            continue
        was, becomes = _changed(old, new)
        was, becomes = (lines[::-1] for lines in _changed(was[::-1], becomes[::-1]))
        yield Mutant(
            module,
            places.get(first, "module"),
            functions.get(first, ""),
            first,
            last,
            "\n".join(line.strip() for line in was),
            "\n".join(line.strip() for line in becomes),
            code,
        )


def _changed(old: list[str], new: list[str]) -> tuple[list[str], list[str]]:
    """Both without the lines that they begin with in common."""
    same = len([*takewhile(lambda pair: pair[0] == pair[1], zip(old, new, strict=False))])
    return old[same:], new[same:]


def _functions(source: str) -> Iterator[tuple[str, range, bool]]:
    """Functions and classes with their lines, outer ones first, and whether it is an outermost function."""
    waiting: list[tuple[str, ast.AST, bool]] = [("", ast.parse(source), False)]
    while waiting:
        outer, node, inside = waiting.pop(0)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                name = f"{outer}.{child.name}".lstrip(".")
                is_function = isinstance(child, ast.FunctionDef)
                lines = range(child.lineno, (child.end_lineno or 0) + 1)
                yield name, lines, is_function and not inside
                waiting.append((name, child, inside or is_function))
