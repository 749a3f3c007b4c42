"""How far the vocabulary is standard: names in the code, constants, words and sentences in the documentation.

Prints each measure with its goal; with `--list` also what falls short of it. Static and deterministic: it parses the
files and imports nothing of the package, so it runs in a second or two.

    python experiments/vocabulary.py [--list]
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
PARTS = Path(__file__).parent / "vocabulary_parts"
MAX_SENTENCE_WORDS = 30  # a longer sentence has to be read twice
DOCUMENTED_CLASSES = {"Errors": "diagnose: its public result", "Finding": "diagnose: its public result"}
"""Class names that stay in several rooms, and why."""
TEXTBOOK = frozenset(
    "acausality arx bisquare compute cross_validate demo dof era exp6 forward_kinematics geodesic identity inverse_kinematics "
    "jacobian jerk log6 lowpass main modal monte_carlo n4sid pbsid prbs pseudo_inertia quaternion right_jacobian skew "
    "to_csv to_json trace".split()
)
"""Functions called as in textbooks or by a custom of Python; they need no verb."""
VAGUE_CONSTANT = re.compile(
    r"_?(MOST|FEWEST|LARGEST|LONGEST|SHORTEST|SMALLEST|SURE|FAR|SAME|NEAR|ROUNDS|TRIES)(_\w+)?$"
)
PRIVATE_ENGLISH = {
    "headless what": (
        r"\b[Ww]hat (?:is|are|was|it|they|a|an|the|no|other|comes|stands|hangs|lies|leaves|left|one|makes|may|could|would|had|has"
        r"|each|its|does|did)\b",
        2.0,
    ),
    "tell": (r"\b(?:told|tells?|telling)\b", 1.0),
    "say": (r"\b(?:said|says?)\b", 2.0),
    "stand, lie, sit": (r"\b(?:stands?|lies|sits)\b", 2.0),
    "beside": (r"\bbeside\b", 0.5),
    "alike, anew, apart": (r"\b(?:alike|likewise|anew|aside|apart|thereby|thereof|hence)\b", 1.0),
    "bears, held against": (r"\b(?:bears?|borne|held against|makes? up for)\b", 0.3),
    "nothing, nobody, none": (r"\b(?:nothing|nobody|none)\b", 6.0),
    "fronted of, from, by": (r"(?:^|(?<=[.;:] ))(?:Of|From|By) [a-z]", 3.0),
}
"""Constructions that peer projects hardly use, as patterns, and the most of each in 10,000 words.

Eight projects with 121,000 words of docstrings (mink, pink, qpsolvers, lmfit, mujoco.sysid, python-control and others) are below
every one of these rates.
"""
HISTORY = re.compile(
    r"\b(earlier (engine|version|session|seed)s?|previous(ly)?|formerly|used to be|no longer|until now|so far this page|"
    r"before this (change|session|version)|as it was|was (once|first) (written|measured)|this page said|"
    r"(this|last|that) session)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Measure:
    """One measure: what it counts, its value, the goal, and what falls short."""

    name: str
    value: str
    goal: str
    met: bool
    items: list[str] = field(default_factory=list)


def read_words(name: str) -> frozenset[str]:
    """Return the words of a list beside this script."""
    text = (PARTS / name).read_text(encoding="utf-8")
    return frozenset(word for line in text.splitlines() if not line.startswith("#") for word in line.split())


def parse_package(root: Path) -> dict[str, ast.Module]:
    """Return the syntax tree of every module, by its path below the package."""
    package = root / "src" / "tau_dyn"
    return {p.relative_to(package).as_posix(): ast.parse(p.read_text("utf-8")) for p in sorted(package.rglob("*.py"))}


def list_definitions(tree: ast.Module) -> Iterator[tuple[str, ast.stmt]]:
    """Yield what a module defines at its top: functions, classes, constants, and `Class.member` of each class."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node
        for target in node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]:
            if isinstance(target, ast.Name):
                yield target.id, node
        for member in node.body if isinstance(node, ast.ClassDef) else []:
            name = getattr(member, "name", None) or getattr(getattr(member, "target", None), "id", None)
            if name:
                yield f"{node.name}.{name}", member


def count_glossary_terms(trees: dict[str, ast.Module]) -> Measure:
    """Count old names of the glossary that are still defined in their file, or in the file that it became."""
    found = []
    for line in (PARTS / "replaced_names.txt").read_text("utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        files, _, names = line.partition(": ")
        old, _, new = files.partition(">")
        current = f"{old.rpartition('/')[0]}/{new}" if new else old
        if new and old in trees:
            found.append(f"{old}: file name")
        for path in {old, current} & trees.keys():
            here = {name for name, _ in list_definitions(trees[path])}
            found += [f"{path}: {name}" for name in names.split() if name in here]
    return Measure("old names of the glossary in src", str(len(found)), "0", not found, sorted(found))


def count_verbless_functions(trees: dict[str, ast.Module]) -> Measure:
    """Count public functions whose name begins with no verb in the imperative."""
    verbs = read_words("verbs.txt")
    names = [(path, n.name) for path, tree in trees.items() for n in tree.body if isinstance(n, ast.FunctionDef)]
    public = [(path, name) for path, name in names if not name.startswith("_")]
    odd = [f"{p}: {n}" for p, n in public if n.split("_")[0] not in verbs and n not in TEXTBOOK]
    share = 100 * len(odd) / max(len(public), 1)
    return Measure("public functions that are no verb phrase", f"{len(odd)} ({share:.1f} %)", "< 2 %", share < 2, odd)


def count_shared_classes(trees: dict[str, ast.Module]) -> Measure:
    """Count class names that stand in more than one room."""
    rooms = defaultdict(set)
    for path, tree in trees.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                rooms[node.name].add(path.split("/")[0])
    shared = [
        f"{n}: {', '.join(sorted(r))}" for n, r in sorted(rooms.items()) if len(r) > 1 and n not in DOCUMENTED_CLASSES
    ]
    return Measure("class names in several rooms", str(len(shared)), "0", not shared, shared)


def is_numeric(node: ast.expr) -> bool:
    """Return whether an expression is a number written out."""
    parts = list(ast.walk(node))
    numbers = [n for n in parts if isinstance(n, ast.Constant) and isinstance(n.value, int | float)]
    allowed = ast.Constant | ast.UnaryOp | ast.BinOp | ast.operator | ast.unaryop
    return bool(numbers) and all(isinstance(n, allowed) for n in parts)


def count_unexplained_constants(root: Path, trees: dict[str, ast.Module]) -> tuple[Measure, Measure]:
    """Count numeric constants with no comment or docstring, and constants whose name tells no quantity."""
    bare, vague = [], []
    for path, tree in trees.items():
        lines = (root / "src" / "tau_dyn" / path).read_text("utf-8").splitlines()
        for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if not isinstance(target, ast.Name) or not target.id.isupper():
                continue
            if VAGUE_CONSTANT.match(target.id):
                vague.append(f"{path}:{node.lineno}: {target.id}")
            told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            near = "#" in lines[(node.end_lineno or node.lineno) - 1] or lines[node.lineno - 2].lstrip().startswith("#")
            if is_numeric(node.value) and not told and not near:
                bare.append(f"{path}:{node.lineno}: {target.id}")
    return (
        Measure("numeric constants without explanation", str(len(bare)), "0", not bare, bare),
        Measure("constants named MOST, FEWEST, SURE, ...", str(len(vague)), "0", not vague, vague),
    )


def list_messages(trees: dict[str, ast.Module]) -> Iterator[tuple[str, str]]:
    """Yield the texts of exceptions and warnings, what they quote as one word, with where they stand."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.Raise) or not isinstance(node.exc, ast.Call):
                continue
            for text in node.exc.args:
                parts = text.values if isinstance(text, ast.JoinedStr) else [text]
                plain = [p.value if isinstance(p, ast.Constant) and isinstance(p.value, str) else "x" for p in parts]
                yield f"{path}:{node.lineno}", "".join(plain)


GENERATED_PAGES = tuple(f"docs/reference/{name}.md" for name in ("causes", "commands", "message_codes"))
"""Pages that scripts write from tables of the code; their words are counted there."""


def read_pages(root: Path) -> dict[str, str]:
    """Return the text of README and of every page, code blocks, comments and pictures left out."""
    pages = {}
    for path in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        text = re.sub(r"^( *)(```|~~~).*?^\1\2", "", path.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
        pages[path.relative_to(root).as_posix()] = re.sub(r"<!--.*?-->|!\[[^\]]*\]\([^)]*\)", "", text, flags=re.DOTALL)
    return pages


def split_sentences(text: str) -> Iterator[str]:
    """Yield the sentences of prose; a heading, an item and a table's cell end one."""
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*#]|\d+\.|\|) ?)|\|", text):
        plain = " ".join(re.sub(r"\$\$?.*?\$\$?", "x", re.sub(r"`[^`]*`", "x", block), flags=re.DOTALL).split())
        yield from (s for s in re.split(r"(?<=[.!?:;])\s+(?=[A-Z\"'(*`\[x])", plain) if s)


def measure_prose(root: Path, trees: dict[str, ast.Module]) -> list[Measure]:
    """Measure the words, the long sentences and the mentions of history in documentation and messages."""
    pages = read_pages(root)
    written = {page: text for page, text in pages.items() if page.startswith("docs/") and page not in GENERATED_PAGES}
    words = {page: len(re.findall(r"\w[\w'-]*", text)) for page, text in written.items()}
    total = sum(words.values())
    texts = [*pages.items(), *list_messages(trees)]
    sentences = [(where, s) for where, text in texts for s in split_sentences(text)]
    far = [f"{where}: {s[:90]}" for where, s in sentences if len(re.findall(r"\w[\w'-]*", s)) > MAX_SENTENCE_WORDS]
    share = 100 * len(far) / max(len(sentences), 1)
    old = [f"{page}: {m.group()}" for page, text in pages.items() for m in HISTORY.finditer(text)]
    by_size = [f"{n:6d} {page}" for page, n in sorted(words.items(), key=lambda x: -x[1])]
    return [
        Measure("words in docs", f"{total:,}", "< 33,000", total < 33_000, by_size),
        Measure("sentences over 30 words", f"{len(far)} of {len(sentences)} ({share:.1f} %)", "< 2 %", share < 2, far),
        Measure("mentions of history in README and docs", str(len(old)), "0", not old, old),
    ]


def list_docstrings(trees: dict[str, ast.Module]) -> Iterator[tuple[str, str]]:
    """Yield the docstrings of modules, classes and functions with their places."""
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                yield f"{path}:{getattr(node, 'lineno', 1)}", text


def measure_private_english(name: str, texts: list[tuple[str, str]]) -> Measure:
    """Measure how many constructions of private English exceed their rate in some texts with places."""
    words = sum(len(text.split()) for _, text in texts)
    found, broken = [], 0
    for rule, (pattern, most) in PRIVATE_ENGLISH.items():
        hits = [f"{place}: {m.group()}" for place, text in texts for m in re.finditer(pattern, text, re.MULTILINE)]
        rate = 1e4 * len(hits) / max(words, 1)
        broken += rate > most
        found += [f"{rule}: {rate:.1f} of at most {most:g}", *hits] if rate > most else []
    return Measure(name, f"{broken} of {len(PRIVATE_ENGLISH)} rules", "0", not broken, found)


def measure_vocabulary(root: Path = ROOT) -> list[Measure]:
    """Return all measures of a source tree."""
    trees = parse_package(root)
    names = [count_glossary_terms(trees), count_verbless_functions(trees), count_shared_classes(trees)]
    pages = [item for item in read_pages(root).items() if item[0] != "README.md"]
    plain = [(place, re.sub(r"\$\$.*?\$\$|`[^`]*`", " ", text, flags=re.DOTALL)) for place, text in pages]
    english = [
        measure_private_english("private English in docstrings and docs", [*list_docstrings(trees), *plain]),
        measure_private_english("private English in messages", list(list_messages(trees))),
    ]
    return [*names, *count_unexplained_constants(root, trees), *measure_prose(root, trees), *english]


def main() -> None:
    """Print the measures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--list", action="store_true", help="print what falls short, too")
    parser.add_argument("--root", type=Path, default=ROOT, help="the tree to measure (default: this one)")
    options = parser.parse_args()
    for measure in measure_vocabulary(options.root):
        print(f"{'met ' if measure.met else 'open'}  {measure.name:42} {measure.value:>22}   goal {measure.goal}")
        if options.list:
            rooms = Counter(item.split("/")[0] for item in measure.items)
            print(*(f"        {item}" for item in measure.items), sep="\n")
            print(f"        by room: {dict(rooms.most_common())}")


if __name__ == "__main__":
    main()
