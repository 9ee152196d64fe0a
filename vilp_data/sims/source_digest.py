"""Whether the code that would record an episode is the code that did: a digest of the modules that make it what it is."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

_ENTRY_POINT = re.compile(r"([\w.]+):\w+")


def source_digest(modules: Sequence[str]) -> str:
    """SHA-256 of what these modules do, and those beside them in the same folder that they import or name as "module:Attribute", and so on.

    Nothing is executed but the packages that they lie in. Comments, docstrings and layout do not count, nor does what is installed
    (its version is told apart from this). A module that is not found, or is no Python source, counts by its name."""
    digest = hashlib.sha256()
    seen: set[str] = set()
    waiting = list(modules)
    while waiting:
        name = waiting.pop(0)
        if name in seen:
            continue
        seen.add(name)
        path = _source(name)
        tree = None if path is None else _without_docstrings(path)
        digest.update(f"{name}\n{'' if tree is None else ast.unparse(tree)}\n".encode())
        if path is not None and tree is not None and "site-packages" not in path.parts:
            package = name if path.name == "__init__.py" else name.rpartition(".")[0]
            waiting += sorted(other for other in {*_named(tree, package)} if _is_beside(other, path))
    return digest.hexdigest()


def _source(module: str) -> Path | None:
    try:
        found = importlib.util.find_spec(module)
    except (ImportError, ValueError, AttributeError):
        return None
    return (
        Path(found.origin) if found is not None and found.origin is not None and found.origin.endswith(".py") else None
    )


def _is_beside(module: str, path: Path) -> bool:
    other = _source(module)
    return other is not None and other.parent == path.parent


def _without_docstrings(path: Path) -> ast.Module | None:
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            told = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
            node.body = told or [ast.Pass()]
    return tree


def _named(tree: ast.Module, package: str) -> Iterator[str]:
    """Every module that the source may mean: `from a import b` is the module a, and a.b if there is one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and (named := _ENTRY_POINT.fullmatch(str(node.value))):
            yield named[1]
