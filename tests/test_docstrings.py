"""Docstrings state what ruff cannot check: errors raised, and shapes and units of arrays."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("can_dbc", "controller", "plant", "sil")
ARRAY = re.compile(r"\b(NDArray|ndarray|Floats|Ints|Bools|ArrayLike)\b")
SHAPE = re.compile(r"\[[^\]\n]*\]|scalar|0-d|shape")
UNDOCUMENTED = {"NotImplementedError", "AssertionError", "StopIteration", "KeyboardInterrupt"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def functions(tree: ast.AST, owner: str = "") -> Iterator[tuple[str, Function]]:
    """Yield (qualified name, node) of every public function and method."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from functions(node, f"{owner}{node.name}.")
        elif isinstance(node, Function) and not node.name.startswith("_"):
            yield f"{owner}{node.name}", node


def raised(function: Function) -> set[str]:
    """Return the names of exceptions that the body of a function raises itself."""
    found: set[str] = set()
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        if isinstance(node, Function | ast.ClassDef | ast.Lambda):
            continue
        if isinstance(node, ast.Raise) and node.exc is not None:
            called = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")
            if name[:1].isupper() and name not in UNDOCUMENTED:
                found.add(name)
        pending.extend(ast.iter_child_nodes(node))
    return found


def has_arrays(function: Function) -> bool:
    """Return whether a parameter or the result of a function is annotated as an array."""
    arguments = function.args
    hints = [a.annotation for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return any(
        hint is not None and ARRAY.search(ast.unparse(hint)) for hint in (*hints, function.returns)
    )


def is_property_or_overload(function: Function) -> bool:
    """Return whether a decorator makes a docstring of its own needless."""
    names = {ast.unparse(decorator) for decorator in function.decorator_list}
    return bool(names & {"overload", "typing.overload", "override"})


def problems(folders: tuple[str, ...] = PACKAGES) -> list[str]:
    """Return one line for each docstring that leaves out errors, shapes or units."""
    found = []
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for name, node in functions(tree):
                text = ast.get_docstring(node) or ""
                line = f"{path.relative_to(ROOT)}:{node.lineno}: {name}"
                if is_property_or_overload(node):
                    continue
                if raised(node) and not re.search(r"\b[Rr]ais(es?|ed)\b", text):
                    found.append(
                        f"{line}: raises {', '.join(sorted(raised(node)))}; not documented"
                    )
                if has_arrays(node) and not SHAPE.search(text):
                    found.append(f"{line}: arrays without a shape such as [n] and a unit")
    return found


def test_docstrings_state_errors_and_shapes() -> None:
    found = problems()
    assert found == [], f"{len(found)} problems\n" + "\n".join(found)


def test_the_check_can_fail() -> None:
    source = '''
def read(path, values: Floats) -> None:
    """Read a file."""
    raise InputError("no")
'''
    ((name, node),) = functions(ast.parse(source))
    assert (name, raised(node), has_arrays(node)) == ("read", {"InputError"}, True)


if __name__ == "__main__":
    for line in problems(tuple(sys.argv[1:]) or PACKAGES):
        print(line)
