"""No source runs what it reads: no pickle, no eval, no shell, no loader that would."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("src", "tools", "benchmarks")
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
CALLS = {
    *("eval", "exec", "__import__", "os.system", "os.popen", "pty.spawn", "tempfile.mktemp"),
    *("torch.load", "torch.save", "torch.jit.load", "pandas.read_pickle", "runpy.run_path"),
    *("yaml.load", "yaml.load_all", "yaml.unsafe_load", "yaml.full_load", "yaml.dump"),
    *("subprocess.getoutput", "subprocess.getstatusoutput", "shutil.unpack_archive"),
}
WITHOUT_PICKLE = {"load", "save", "savez", "savez_compressed"}
NUMPY = {"np", "numpy"}


def offences(source: str) -> Iterator[str]:
    """What a module does that it must not, with the line."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            names = []
        for name in names:
            if name.split(".")[0] in MODULES:
                yield f"line {node.lineno}: imports {name}"
        if isinstance(node, ast.Call):
            yield from (f"line {node.lineno}: {fault}" for fault in _faults(node))


def _faults(call: ast.Call) -> Iterator[str]:
    name = ast.unparse(call.func)
    given = {word.arg: ast.unparse(word.value) for word in call.keywords}
    if name in CALLS:
        yield f"calls {name}"
    if given.get("shell", "False") != "False":
        yield f"{name} with a shell"
    owner, _, method = name.rpartition(".")
    if owner in NUMPY and method in WITHOUT_PICKLE and given.get("allow_pickle") != "False":
        yield f"{name} without allow_pickle=False"


@pytest.mark.parametrize("folder", FOLDERS)
def test_nothing_that_is_read_is_run(folder: str) -> None:
    files = sorted((ROOT / folder).rglob("*.py"))
    assert files
    found = [
        f"{path.relative_to(ROOT)}, {offence}"
        for path in files
        for offence in offences(path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from marshal import loads",
        "eval('1')",
        "import yaml\nyaml.load(text)",
        "torch.load(path)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.save(file, a)",
        "subprocess.run(command, shell=True)",
        "subprocess.run(command, shell=flag)",
        "os.system('ls')",
    ],
)
def test_an_offence_is_seen(source: str) -> None:
    assert list(offences(source))


def test_what_is_harmless_is_not_an_offence() -> None:
    source = "np.load(p, allow_pickle=False)\nyaml.safe_load(t)\nmodel.eval()\nast.literal_eval(x)"
    assert not list(offences(source))
