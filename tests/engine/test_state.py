"""The state is closed: only its own methods write to it."""

import ast
from pathlib import Path

import mkpc_kaggle
from mkpc_kaggle.engine.plan import scene_state, state

PACKAGE = Path(mkpc_kaggle.__file__).parent
CHANGES = {
    "add",
    "append",
    "clear",
    "discard",
    "extend",
    "fill",
    "pop",
    "remove",
    "setdefault",
    "update",
}


def is_of_state(node: ast.expr) -> bool:
    """Whether an expression is an attribute of a state, such as ``run.state.points[index]``."""
    while isinstance(node, ast.Subscript):
        node = node.value
    if not isinstance(node, ast.Attribute):
        return False
    owner = node.value
    # Also of its scenes, as in ``state.scenes.stale``
    if isinstance(owner, ast.Attribute) and owner.attr == "scenes":
        return is_of_state(owner)
    name = owner.attr if isinstance(owner, ast.Attribute) else getattr(owner, "id", "")
    return name in ("state", "_state")


def writes(source: str) -> list[int]:
    """The lines of a module that write to an attribute of a state."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Assign(targets=targets) | ast.Delete(targets=targets):
                changed = targets
            case ast.AugAssign(target=target) | ast.AnnAssign(target=target):
                changed = [target]
            case ast.Call(func=ast.Attribute(attr=name, value=value)) if name in CHANGES:
                changed = [value]
            case _:
                continue
        if any(is_of_state(each) for each in changed):
            found.append(node.lineno)
    return found


def test_only_the_methods_of_the_state_write_its_arrays():
    examples = (
        "state.has[3] = True; run.state.scenes.stale.add(1); self._state.order = 2; state.x[1] |= 3"
    )
    assert len(writes(examples.replace("; ", "\n"))) == 4
    own = (Path(state.__file__), Path(scene_state.__file__))
    found = {
        str(path.relative_to(PACKAGE)): lines
        for path in PACKAGE.rglob("*.py")
        if path not in own and (lines := writes(path.read_text(encoding="utf-8")))
    }
    assert found == {}
