"""What a class or function accepts, read from its source: nothing is imported, so that mistakes are found at once."""

import ast
import functools
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path


@functools.cache
def signature(target: str) -> dict[str, str] | None:
    """Argument names and annotations of a class or function, from its source; None if it can't be found there.

    `**` is among the names where any keyword is accepted.
    """
    package, *modules, name = target.split(".")
    spec = find_spec(package) if modules else None
    if spec is None or not spec.submodule_search_locations:
        return None
    path = Path(spec.submodule_search_locations[0]).joinpath(*modules)
    file = next((f for f in (path.with_suffix(".py"), path / "__init__.py") if f.is_file()), None)
    if file is None:
        return None
    definitions = {
        node.name: node for node in ast.parse(file.read_text()).body if isinstance(node, ast.ClassDef | ast.FunctionDef)
    }
    return _arguments(definitions, name)


def _arguments(definitions: Mapping[str, ast.ClassDef | ast.FunctionDef], name: str) -> dict[str, str] | None:
    node = definitions.get(name)
    if isinstance(node, ast.ClassDef):
        init = next((n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"), None)
        if init is None and any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
            fields = [n for n in node.body if isinstance(n, ast.AnnAssign)]
            return {ast.unparse(field.target): ast.unparse(field.annotation) for field in fields}
        if init is None:
            base = next((b.id for b in node.bases if isinstance(b, ast.Name)), "")
            return _arguments(definitions, base)
        node = init
    if node is None:
        return None
    found = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    names = {a.arg: ast.unparse(a.annotation) if a.annotation else "" for a in found if a.arg != "self"}
    return names | ({"**": ""} if node.args.kwarg else {})
