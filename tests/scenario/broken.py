"""A table of broken topology files: what is wrong in each, and the place where the user must be sent.

A case is the small valid file below with some text replaced. The sign § in the new text marks the place where a problem
must be reported (it is cut out before the file is written): the table states the positions, the loader must find them.
Every mark has its words, in the order of the marks; nothing but the marked problems may be reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

MARK = "§"

VALID = """\
name: tiny
description: Two states, two nodes
plant:
  time: discrete
  period: 1.0
  A: [[0.5, 0.1], [0.0, 0.5]]
  B: [[1.0], [0.0]]
  inputs: [heater]
  E: [[0.0], [1.0]]
  x0: [1.0, 0.0]
  control: {signals: {heater: {sine: {amplitude: 1, period: 10}}}}
  disturbance: [{constant: {value: 1}}]
  noise: {variance: 0.01}
observer:
  method: lmi
  decomposition: observability
nodes:
  1: {C: [[1, 0]], knows: [heater]}
  2: {C: [[0, 1]], knows: []}
graph:
  edges: [[1, 2]]
run:
  steps: 10
  seed: 0
  convergence: {rms_below: 0.5, over_last: 0.5}
"""

PLANT_FILE = """\
time: discrete
period: 1.0
A: [[0.5, 0.1], [0.0, 0.5]]
B: [[1.0], [0.0]]
inputs: [heater]
E: [[0.0], [1.0]]
x0: [1.0, 0.0]
"""


class Expected(NamedTuple):
    """One problem: file name, line and column (from 1), and words that its message must hold."""

    file: str
    line: int
    column: int
    words: str


@dataclass(frozen=True)
class Case:
    """Files by name (the topology is ``broken.yaml``), and every problem that must be reported."""

    name: str
    files: dict[str, bytes]
    expected: tuple[Expected, ...]

    def write(self, folder: Path) -> Path:
        """Write the files into ``folder``; the path of the topology."""
        for name, data in self.files.items():
            (folder / name).write_bytes(data)
        return folder / "broken.yaml"


def case(name: str, *edits: tuple[str, str], words: str | tuple[str, ...], plant: str | None = None) -> Case:
    """The valid file with each (old, new) replaced, and perhaps a (marked) plant file ``plant.yaml`` beside it."""
    text = VALID
    for old, new in edits:
        assert text.count(old) == 1, f"{name}: {old!r} is not once in the file"
        text = text.replace(old, new)
    return marked(name, {"broken.yaml": text} | ({"plant.yaml": plant} if plant is not None else {}), words)


def marked(name: str, texts: dict[str, str], words: str | tuple[str, ...]) -> Case:
    """A case from whole texts with marks in them."""
    words = (words,) if isinstance(words, str) else words
    places = []
    for file, text in texts.items():
        parts = text.split(MARK)
        for k in range(1, len(parts)):
            before = "".join(parts[:k]).split("\n")
            places.append((file, len(before), len(before[-1]) + 1))
    assert len(places) == len(words), f"{name}: {len(places)} marks, {len(words)} words"
    expected = tuple(Expected(*place, said) for place, said in zip(places, words, strict=True))
    return Case(name, {file: text.replace(MARK, "").encode() for file, text in texts.items()}, expected)


def raw(name: str, data: bytes, line: int, column: int, words: str) -> Case:
    """A case from bytes that are not text."""
    return Case(name, {"broken.yaml": data}, (Expected("broken.yaml", line, column, words),))


def without(start: str, end: str) -> str:
    """The valid file's text from ``start`` up to ``end``: what to replace in order to delete it."""
    return VALID[VALID.index(start) : VALID.index(end)]


# fmt: off
SYNTAX = [
    raw("empty file", b"", 1, 1, "the file is empty"),
    raw("only a comment", b"# nothing\n", 1, 1, "the file is empty"),
    raw("not UTF-8", b"name: tiny\ndescription: \xff\xfe\n", 2, 14, "not UTF-8"),
    raw("UTF-16", "name: tiny".encode("utf-16"), 1, 1, "not UTF-8"),
    raw("binary", b"name: \x00\x01\x02", 1, 7, "control character"),
    raw("escape character", b"name: a\n\ndescription: \x1b[31m", 3, 14, "control character U+001B"),
    raw("a list", b"- name: tiny\n", 1, 1, "should be a mapping"),
    raw("only text", b"# hello\n  hello\n", 2, 3, "should be a mapping"),
    raw("deep nesting", b"name: " + b"[" * 1500, 1, 1, "nested too deeply"),
    case("nested lists", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: [[" + MARK + "[" * 13 + MARK + "[[1]]" + "]" * 15),
         words=("plant.A.0.0: should be a number, not a list", "nested too deeply")),
    case("unclosed list", ("[[1, 2]]\nrun:", "[[1, 2]\n§run:"), words="not valid YAML"),
    case("tab", ("  steps: 10", "§\tsteps: 10"), words="not valid YAML"),
    case("two documents", ("graph:", "§---\ngraph:"), words="another document"),
    case("directive", ("name: tiny", "§%YAML 1.1\n---\nname: tiny"), words="directives"),
    case("duplicate key", ("  seed: 0", "  seed: 0\n  §steps: 20"),
         words="run.steps: is given twice, first on line 23"),
    case("duplicate node", ("  2: {C: [[0, 1]], knows: []}", "  2: {C: [[0, 1]]}\n  §2: {C: [[1, 1]]}"),
         words="nodes.2: is given twice"),
    case("duplicate key in a plant", ("  inputs: [heater]", "  inputs: [heater]\n  §A: [[1]]"),
         words="plant.A: is given twice"),
    case("alias", ("1: {C: [[1, 0]]", "1: {C: §&c [[1, 0]]"), ("{C: [[0, 1]]", "{§C: *c"),
         words=("nodes.1.C: anchors (&c) are not allowed", "nodes.2.C: aliases (*c) are not allowed")),
    case("anchor on a mapping", ("nodes:\n", "nodes: §&all\n"), words="anchors (&all)"),
    case("undefined alias", ("C: [[0, 1]]", "C: §*c"), words="undefined alias"),
    case("merge key", ("2: {C: [[0, 1]]", "2: {§<<: {}, C: [[0, 1]]"), words="unknown key"),
    case("tag", ("steps: 10", "steps: §!!int 10"), words="tags"),
    case("python tag", ("steps: 10", "steps: §!!python/object/apply:os.system ['true']"), words="tags"),
    case("list as key", ("  seed: 0", "  ? §[1, 2]\n  : 0"), words="cannot be a key"),
    case("number as key", ("  seed: 0", "  §7: 0"), words="should be text"),
    case("null as key", ("  seed: 0", "  §~: 0"), words="should be text"),
]

NUMBERS = [
    case("nan in A", ("[0.0, 0.5]]", "[0.0, §.nan]]"), words="plant.A.1.1: should be a finite number, not .nan"),
    case("inf in C", ("C: [[1, 0]]", "C: [[§-.inf, 0]]"), words="nodes.1.C.0.0: should be a finite number"),
    case("nan where one of several keys is needed", ("{variance: 0.01}", "{variance: §.nan}"),
         words="plant.noise.variance: should be a finite number, not .nan"),
    case("overflow", ("period: 1.0", "period: §1e999"), words="should be a finite number, not 1e999"),
    case("nan as a word", ("rms_below: 0.5", "rms_below: §nan"), words="should be a number, not the text 'nan'"),
    case("underscore number", ("steps: 10", "steps: §1_000"), words="should be a whole number, not the text '1_000'"),
    case("comma number", ("period: 1.0", "period: §1,5"), words="should be a number, not the text '1,5'"),
    case("huge integer", ("seed: 0", "seed: §99999999999999999999"), words="too large"),
    case("endless integer", ("seed: 0", "seed: §" + "9" * 5000), words="finite"),
    case("number in quotes", ("x0: [1.0, 0.0]", "x0: [§'1.0', 0.0]"),
         words="plant.x0.0: should be a number, not the text '1.0'"),
    case("boolean in a matrix", ("[0.0, 0.5]]", "[0.0, §true]]"), words="should be a number, not true"),
    case("boolean steps", ("steps: 10", "steps: §true"), words="should be a whole number, not true"),
    case("empty entry", ("[0.0, 0.5]]", "[0.0, §~]]"), words="should be a number, not nothing"),
    case("formula", ("value: 1}", "value: §2*pi}"), words="should be a number, not the text '2*pi'"),
]

TOP = [
    case("no name", ("name: tiny\ndescription", "§description"), words="name: is missing"),
    case("name with a slash", ("name: tiny", "name: §t/tiny"), words="have only these, '.', '_' and '-' in it"),
    case("name that begins with _", ("name: tiny", "name: §_x"), words="should begin with a letter or digit"),
    case("name is a number", ("name: tiny", "name: §7"), words="should be text, not 7"),
    case("empty name", ("name: tiny", "§name:"), words="should be text, not nothing"),
    case("description is a list", ("description: Two states, two nodes", "description: §[1]"), words="should be text"),
    case("unknown top key", ("graph:", "§grahp:"), ("name: tiny", "§name: tiny"),
         words=("graph: is missing", "grahp: unknown key (did you mean graph?)")),
    case("timing without a mode", ("run:", "§timing: {}\nrun:"), words="timing.mode: is missing"),
    case("timing that is no mode", ("run:", "timing: §realtme\nrun:"),
         words="timing: should be 'lockstep' or 'realtime' or a mapping, not the text 'realtme' (did you mean"),
    case("tick in lockstep", ("run:", "timing: {mode: lockstep, §tick: 1}\nrun:"),
         words="timing.tick: belongs to realtime"),
    case("tick too fast", ("run:", "timing: {mode: realtime, tick: §1e-4}\nrun:"), words="should be at least 0.001"),
    case("wait too long", ("run:", "timing: {mode: realtime, wait: §1}\nrun:"), words="should be at most 0.9, not 1"),
    case("a period that is no tick", ("run:", "timing: §realtime\nrun:"), ("period: 1.0", "period: 1e-5"),
         words="timing: the plant's own 1e-05 s per sample are no tick for a wall clock; say how many seconds"),
    case("batches in real time", ("run:", "timing: realtime\nrun:"), ("seed: 0", "seed: 0\n  batch: §4"),
         words="run.batch: should be 1 under timing: realtime, not 4"),
    case("sections missing", ("name: tiny", "§§§name: tiny"), (without("plant:", "observer:"), ""),
         (without("nodes:", "graph:"), ""), (VALID[VALID.index("run:") :], ""),
         words=("plant: is missing", "nodes: is missing", "run: is missing")),
]

PLANT = [
    case("plant is a number", (without("plant:", "observer:"), "plant: §3\n"),
         words="plant: should be a mapping, not 3"),
    case("plant is empty", (without("plant:", "observer:"), "§plant:\n"),
         words="plant: should be a mapping, not nothing"),
    case("no time", ("plant:\n  time: discrete", "§plant:"), words="plant.time: is missing"),
    case("wrong time", ("time: discrete", "time: §discreet"), words="(did you mean discrete?)"),
    case("no period", ("  period: 1.0\n", ""), ("plant:", "§plant:"),
         words="plant.period: is missing: a discrete plant"),
    case("period zero", ("period: 1.0", "period: §0"), words="should be at least 1e-09, not 0"),
    case("negative period", ("period: 1.0", "period: §-1"), words="plant.period: should be at least"),
    case("continuous with period", ("time: discrete", "time: continuous"), ("  period", "  §period"), ("run:", "§run:"),
         words=("does not belong to a continuous plant", "run.step: is missing: a continuous plant")),
    case("discrete with step", ("  seed: 0", "  §step: 0.1"), words="run.step: does not belong to a discrete plant"),
    case("no A", ("  A: [[0.5, 0.1], [0.0, 0.5]]\n", ""), ("plant:", "§plant:"), words="plant.A: is missing"),
    case("A is a vector", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: [§1, §2]"),
         words=("plant.A.0: should be a list, not 1", "plant.A.1: should be a list, not 2")),
    case("A is a number", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: §0.5"), words="should be a list, not 0.5"),
    case("A is empty", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: §[]"), words="should have at least 1 entry"),
    case("A is not square", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: §[[0.5, 0.1, 0], [0.0, 0.5, 0]]"),
         words="should have 2 columns (A is square), not 3"),
    case("A is ragged", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: [[0.5, 0.1], §[0.0]]"),
         words="plant.A.1: should have 2 entries"),
    case("B has a row too many", ("B: [[1.0], [0.0]]", "B: §[[1.0], [0.0], [0.0]]"),
         words="plant.B: should have 2 rows (one per state), not 3"),
    case("B is ragged", ("B: [[1.0], [0.0]]", "B: [[1.0], §[0.0, 2.0]]"),
         words="plant.B.1: should have 1 entry (as the first row)"),
    case("inputs too short", ("inputs: [heater]", "inputs: §[]"),
         ("{heater: {sine: {amplitude: 1, period: 10}}}", "[0]"),
         ("knows: [heater]", "knows: []"), words="plant.inputs: should have 1 entry (one name per column of B), not 0"),
    case("input named twice", ("B: [[1.0], [0.0]]", "B: [[1, 0], [0, 1]]"),
         ("inputs: [heater]", "inputs: [heater, §heater]"),
         words="plant.inputs.1: the input heater is named twice"),
    case("input is a number", ("inputs: [heater]", "inputs: [§1]"), words="should be text, not 1"),
    case("input without a name", ("inputs: [heater]", "inputs: [§'']"), words="should not be empty"),
    case("inputs without B", ("  B: [[1.0], [0.0]]\n", ""), ("inputs: [heater]", "inputs: §[heater]"),
         ("  control: {signals: {heater: {sine: {amplitude: 1, period: 10}}}}\n", ""), words="should have 0 entries"),
    case("E has a row too few", ("E: [[0.0], [1.0]]", "E: §[[1.0]]"), words="plant.E: should have 2 rows"),
    case("E is text", ("E: [[0.0], [1.0]]", "E: §none"), words="should be a list, not the text 'none'"),
    case("no x0", ("  x0: [1.0, 0.0]\n", ""), ("plant:", "§plant:"), words="plant.x0: is missing"),
    case("x0 too long", ("x0: [1.0, 0.0]", "x0: §[1.0, 0.0, 0.0]"),
         words="should have 2 entries (one per state), not 3"),
    case("x0 is a number", ("x0: [1.0, 0.0]", "x0: §1"), words="should be a list or a mapping, not 1"),
    case("x0 normal without std", ("x0: [1.0, 0.0]", "x0: {§normal: {mean: 1}}"),
         words="plant.x0.normal.std: is missing"),
    case("x0 normal mean too short", ("x0: [1.0, 0.0]", "x0: {normal: {mean: §[1], std: 1}}"),
         words="mean: should have 2 entries"),
    case("x0 normal negative std", ("x0: [1.0, 0.0]", "x0: {normal: {mean: 0, std: [1, §-1]}}"),
         words="should be at least 0, not -1"),
    case("x0 uniform", ("x0: [1.0, 0.0]", "§x0: {§uniform: {mean: 0}}"),
         words=("plant.x0.normal: is missing", "plant.x0.uniform: unknown key; the keys here are normal")),
    case("x0 misspelt", ("x0: [1.0, 0.0]", "x0: {§nromal: {mean: 0, std: 1}}"),
         words="unknown key (did you mean normal?)"),
    case("unknown plant key", ("  inputs:", "  §F: [[1]]\n  inputs:"), words="plant.F: unknown key; the keys here are"),
]

CONTROL = "{signals: {heater: {sine: {amplitude: 1, period: 10}}}}"
WAVE = "{sine: {amplitude: 1, period: 10}}"
TERM = "{constant: {value: 1}}"
NOISE = "{variance: 0.01}"

DRIVES = [
    case("control with two forms", ("control: {signals:", "control: {F: [[1, 1]], §signals:"),
         words="plant.control.signals: give either F or signals, not both"),
    case("control with no form", (CONTROL, "§{}"),
         words="plant.control: should have one of the keys lqr, F or signals"),
    case("control is text", (CONTROL, "§lqr"), words="should be a mapping, not the text 'lqr'"),
    case("control without B", ("  B: [[1.0], [0.0]]\n  inputs: [heater]\n", ""), ("  control:", "  §control:"),
         ("knows: [heater]", "knows: []"), words="plant.control: the plant has no inputs"),
    case("unknown input in the control", ("{heater: {sine", "{§heatre: {sine"),
         words="plant.control.signals.heatre: no such input (did you mean heater?)"),
    case("too many control signals", (f"{{heater: {WAVE}}}", "§[1, 2]"),
         words="should have 1 entry (one per input), not 2"),
    case("F too narrow", (CONTROL, "{F: [§[1]]}"), words="control.F.0: should have 2 entries (one per state), not 1"),
    case("F too high", (CONTROL, "{F: §[[1, 0], [0, 1]]}"),
         words="control.F: should have 1 row (one per input), not 2"),
    case("reference of F too short", (CONTROL, "{F: [[1, 0]], reference: §[1]}"),
         words="reference: should have 2 entries (one per state), not 1"),
    case("reference outside lqr", (CONTROL, "{lqr: {Q: 1, R: 1}, §reference: [1, 1]}"),
         words="control.reference: a reference belongs to F, or inside lqr"),
    case("lqr without R", (CONTROL, "{§lqr: {Q: 1}}"), words="plant.control.lqr.R: is missing"),
    case("Q of the wrong size", (CONTROL, "{lqr: {Q: §[1, 1, 1], R: 1}}"), words="Q: should have 2 entries"),
    case("Q with a word in it", (CONTROL, "{lqr: {Q: [[1, §a], [0, 1]], R: 1}}"),
         words="Q.0.1: should be a number, not the text 'a'"),
    case("Q not symmetric", (CONTROL, "{lqr: {Q: §[[1, 1], [0, 1]], R: 1}}"), words="Q: should be symmetric"),
    case("Q not semidefinite", (CONTROL, "{lqr: {Q: §-1, R: 1}}"), words="Q: should be positive semidefinite"),
    case("R zero", (CONTROL, "{lqr: {Q: 1, R: §0}}"), words="R: should be positive definite"),
    case("R is text", (CONTROL, "{lqr: {Q: 1, R: §big}}"), words="R: should be a number or a list, not the text 'big'"),
    case("lqr reference is a number", (CONTROL, "{lqr: {Q: 1, R: 1, reference: §18}}"),
         words="should be a list, not 18"),
    case("unknown kind of signal", (WAVE, "{§sinus: {amplitude: 1, period: 10}}"),
         words="unknown key (did you mean sine?)"),
    case("code as a signal", (WAVE, "§sin(t)"), words="should be a number, a mapping or a list, not the text 'sin(t)'"),
    case("two kinds in one term", (TERM, "{constant: {value: 1}, §step: {time: 1, after: 2}}"),
         words="give either constant or step, not both"),
    case("empty term", (TERM, "§{}"), words="should have one of the keys constant, sine"),
    case("constant without value", (TERM, "{§constant: {}}"), words="disturbance.0.constant.value: is missing"),
    case("constant is a number", (TERM, "{constant: §1}"), words="constant: should be a mapping, not 1"),
    case("sine without period", (WAVE, "{sine: §{amplitude: 1}}"), words="should have one of the keys period or rate"),
    case("period and rate", (WAVE, "{sine: {period: 1, §rate: 1}}"), words="give either period or rate, not both"),
    case("sine with period 0", (WAVE, "{sine: {period: §0}}"), words="sine.period: should be at least 1e-09, not 0"),
    case("misspelt parameter", (WAVE, "{sine: {amplitude: 1, §peroid: 10}}"),
         words="unknown key (did you mean period?)"),
    case("step without time", (TERM, "{§step: {after: 1}}"), words="step.time: is missing"),
    case("normal with std and variance", (TERM, "{normal: {std: 1, §variance: 1}}"),
         words="give either std or variance"),
    case("normal without std", (TERM, "{normal: §{mean: 1}}"), words="should have one of the keys std or variance"),
    case("normal with negative variance", (TERM, "{normal: {variance: §-1}}"), words="should be at least 0, not -1"),
    case("wrong term in a sum", (f"[{TERM}]", "[[1, {sine: {period: 1}}, {square: {period: §x}}]]"),
         words="plant.disturbance.0.2.square.period: should be a number, not the text 'x'"),
    case("one disturbance too many", (f"[{TERM}]", "§[1, 2]"),
         words="should have 1 entry (one signal per column of E)"),
    case("disturbance without E", ("  E: [[0.0], [1.0]]\n", ""), (f"[{TERM}]", f"§[{TERM}]"),
         words="plant.disturbance: should have 0 entries (one signal per column of E), not 1"),
    case("disturbance is not a list", (f"[{TERM}]", f"§{TERM}"), words="disturbance: should be a list, not a mapping"),
    case("noise is a number", (NOISE, "§0.2"), words="plant.noise: say what 0.2 is: {variance: 0.2} or {std: 0.2}"),
    case("noise misspelt", (NOISE, "{§varience: 0.2}"), words="unknown key (did you mean variance?)"),
    case("noise with two forms", (NOISE, "{variance: 0.2, §std: 0.2}"), words="give either variance or std, not both"),
    case("empty noise", (NOISE, "§{}"), words="should have one of the keys variance, std or channel"),
    case("negative variance", (NOISE, "{variance: §-0.2}"), words="noise.variance: should be at least 0, not -0.2"),
    case("channel without signals", (NOISE, "§{channel: [[1]]}"), words="channel and signals belong together"),
    case("signals without channel", (NOISE, "§{variance: 1, signals: [1]}"),
         words="channel and signals belong together"),
    case("channel with too many rows", ("knows: []", "noise: {channel: §[[1], [1]], signals: [1]}"),
         words="nodes.2.noise.channel: should have 1 row (one per measurement), not 2"),
    case("channel with too few signals", ("knows: []", "noise: {channel: [[1, 1]], signals: §[1]}"),
         words="should have 2 entries (one signal per column of the channel), not 1"),
    case("plant's channel does not fit a node", (NOISE, "{channel: §[[1]], signals: [1]}"),
         ("C: [[0, 1]]", "C: [[0, 1], [1, 0]]"), words="should have 2 rows (one per measurement of node 2), not 1"),
    case("node's noise is text", ("knows: []", "noise: §white"),
         words="nodes.2.noise: should be a mapping or a number"),
]

OBSERVER = [
    case("no observer", ("observer:\n  method: lmi\n  decomposition: observability\n", ""),
         ("name: tiny", "§name: tiny"),
         words="observer: is missing"),
    case("observer is a word", ("observer:\n  method: lmi\n  decomposition: observability", "observer: §lmi"),
         words="observer: should be a mapping, not the text 'lmi'"),
    case("no method", ("observer:\n  method: lmi", "§observer:"), words="observer.method: is missing; the methods are"),
    case("unknown method", ("method: lmi", "method: §lim"), words="no such method: the text 'lim' (did you mean lmi?)"),
    case("method is a list", ("method: lmi", "method: §[lmi]"), words="no such method: a list"),
    case("unknown option", ("  decomposition:", "  §decomp: 1\n  decomposition:"),
         words="observer.decomp: unknown key"),
    case("wrong word", ("observability", "§observabilty"), words="(did you mean observability?)"),
    case("option of the wrong type", ("observability", "§1"),
         words="should be 'detectability' or 'observability', not 1"),
    case("wrong word in a union", ("decomposition: observability", "local_gain: §hinff"), words="(did you mean hinf?)"),
    case("wrong pole", ("decomposition: observability", "local_gain: {poles: [0.1, §x]}"),
         words="observer.local_gain.poles.1: should be a number, not the text 'x'"),
    case("misspelt key in a union", ("decomposition: observability", "local_gain: {§pole: [0.1, 0.2]}"),
         words="observer.local_gain.pole: unknown key (did you mean poles?)"),
]

NODES = [
    case("nodes is a list", (without("nodes:", "graph:"), "nodes: §[{C: [[1, 0]]}]\n"),
         words="nodes: should be a mapping from node ids to nodes, not a list"),
    case("no nodes", (without("nodes:", "graph:"), "nodes: §{}\n"), ("[[1, 2]]", "[]"), words="at least one node"),
    case("empty nodes", (without("nodes:", "graph:"), "§nodes:\n"), ("[[1, 2]]", "[]"),
         words="nodes: should be a mapping from node ids to nodes, not nothing"),
    case("node 0", ("  1: {C", "  §0: {C"), ("[[1, 2]]", "[]"), words="should be a positive whole number, not 0"),
    case("negative node", ("  1: {C", "  §-1: {C"), ("[[1, 2]]", "[]"),
         words="should be a positive whole number, not -1"),
    case("node with a name", ("  1: {C", "  §north: {C"), ("[[1, 2]]", "[]"),
         words="should be a positive whole number, not the text 'north'"),
    case("node id in quotes", ("  1: {C", "  §'1': {C"), ("[[1, 2]]", "[]"), words="whole number, not the text '1'"),
    case("fractional node", ("  1: {C", "  §1.5: {C"), ("[[1, 2]]", "[]"), words="the key 1.5 should be text"),
    case("node is a list", ("1: {C: [[1, 0]], knows: [heater]}", "1: §[[1, 0]]"), words="nodes.1: should be a mapping"),
    case("node without C", ("  1: {C: [[1, 0]], knows: [heater]}", "  §1: {knows: [heater]}"),
         words="nodes.1.C: is missing"),
    case("C too wide", ("[[0, 1]]", "§[[0, 1, 0], [0, 1, 0]]"),
         words="nodes.2.C: should have 2 columns (one per state), not 3"),
    case("C ragged", ("[[1, 0]]", "[[1, 0], §[1]]"), words="nodes.1.C.1: should have 2 entries (one per state), not 1"),
    case("C is a row", ("[[0, 1]]", "[§0, §1]"),
         words=("C.0: should be a list, not 0", "C.1: should be a list, not 1")),
    case("C is empty", ("[[0, 1]]", "§[]"), words="nodes.2.C: should have at least 1 entry"),
    case("C is a word", ("[[0, 1]]", "§eye"), words="nodes.2.C: should be a list, not the text 'eye'"),
    case("unknown input", ("knows: [heater]", "knows: [§heeter]"),
         words="no such input: heeter (did you mean heater?)"),
    case("input number", ("knows: [heater]", "knows: [§0]"), words="nodes.1.knows.0: should be text, not 0"),
    case("input known twice", ("knows: [heater]", "knows: [heater, §heater]"), words="heater is named twice"),
    case("knows is a word", ("knows: [heater]", "knows: §heater"), words="nodes.1.knows: should be a list"),
    case("empty knows", ("knows: []", "§knows: "), words="nodes.2.knows: should be a list, not nothing"),
    case("misspelt node key", ("knows: []", "§know: []"), words="nodes.2.know: unknown key (did you mean knows?)"),
]

GRAPH = [
    case("graph is a list", ("graph:\n  edges: [[1, 2]]", "graph: §[[1, 2]]"), words="graph: should be a mapping"),
    case("graph is empty", ("graph:\n  edges: [[1, 2]]", "§graph:"), words="graph: should be a mapping, not nothing"),
    case("graph without edges", ("graph:\n  edges: [[1, 2]]", "graph: §{}"), words="one of the keys edges or arcs"),
    case("edges and arcs", ("  edges: [[1, 2]]", "  edges: [[1, 2]]\n  §arcs: [[1, 2]]"),
         words="give either edges or arcs"),
    case("edges is a mapping", ("[[1, 2]]", "§{a: 2}"), words="graph.edges: should be a list, not a mapping"),
    case("one end", ("[[1, 2]]", "[§[1]]"), words="graph.edges.0: should have at least 2 entries, not 1"),
    case("four entries", ("[[1, 2]]", "[§[1, 2, 1.0, 2]]"),
         words="graph.edges.0: should have at most 3 entries, not 4"),
    case("edge is a number", ("[[1, 2]]", "[§12]"), words="graph.edges.0: should be a list, not 12"),
    case("unknown node", ("[[1, 2]]", "[[1, §3]]"), words="graph.edges.0.1: no such node: 3; the nodes are 1 and 2"),
    case("two unknown nodes", ("[[1, 2]]", "[[§7, §8]]"), words=("no such node: 7", "no such node: 8")),
    case("fractional end", ("[[1, 2]]", "[[1, §2.0]]"), words="should be the id of a node, not 2.0"),
    case("node in quotes", ("[[1, 2]]", "[[1, §'2']]"), words="should be a number, not the text '2'"),
    case("self-loop", ("[[1, 2]]", "[§[1, 1]]"), words="node 1 cannot be its own neighbour"),
    case("same edge twice", ("[[1, 2]]", "[[1, 2], §[1, 2]]"), words="graph.edges.1: [1, 2] is an edge already"),
    case("same edge turned round", ("[[1, 2]]", "[[1, 2], §[2, 1]]"), words="[2, 1] is an edge already"),
    case("same arc twice", ("edges: [[1, 2]]", "arcs: [[1, 2], [2, 1], §[1, 2, 3.0]]"),
         words="[1, 2] is an arc already"),
    case("weight zero", ("[[1, 2]]", "[[1, 2, §0]]"), words="a weight should be greater than 0, not 0"),
    case("weight negative", ("[[1, 2]]", "[[1, 2, §-0.5]]"), words="a weight should be greater than 0, not -0.5"),
    case("weight nan", ("[[1, 2]]", "[[1, 2, §.nan]]"), words="graph.edges.0.2: should be a finite number"),
    case("misspelt edges", ("  edges:", "  §egdes:"), words="unknown key (did you mean edges?)"),
]

RUN = [
    case("no steps", ("run:\n  steps: 10", "§run:"), words="run.steps: is missing"),
    case("zero steps", ("steps: 10", "steps: §0"), words="run.steps: should be at least 1, not 0"),
    case("fractional steps", ("steps: 10", "steps: §10.0"), words="should be a whole number, not 10.0"),
    case("too many steps", ("steps: 10", "steps: §1000000000000"), words="run.steps: should be at most"),
    case("too large a trace", ("steps: 10", "steps: §99000000"), words="run.steps: should be at most 62500000"),
    case("negative seed", ("seed: 0", "seed: §-1"), words="run.seed: should be at least 0, not -1"),
    case("seed is text", ("seed: 0", "seed: §random"), words="should be a whole number, not the text 'random'"),
    case("no convergence", ("run:", "§run:"), ("  convergence: {rms_below: 0.5, over_last: 0.5}\n", ""),
         words="run.convergence: is missing"),
    case("convergence is a number", ("{rms_below: 0.5, over_last: 0.5}", "§0.5"), words="should be a mapping, not 0.5"),
    case("no rms_below", ("  convergence: {rms_below: 0.5, ", "  §convergence: {"), words="rms_below: is missing"),
    case("rms_below zero", ("rms_below: 0.5", "rms_below: §0"), words="should be greater than 0, not 0"),
    case("over_last zero", ("over_last: 0.5", "over_last: §0"), words="should be greater than 0, not 0"),
    case("over_last above one", ("over_last: 0.5", "over_last: §50"), words="should be at most 1, not 50"),
    case("deadline zero", ("seed: 0", "deadline: §0"), words="run.deadline: should be greater than 0, not 0"),
    case("deadline of a year", ("seed: 0", "deadline: §31536000"), words="run.deadline: should be at most 86400"),
    case("window zero", ("seed: 0", "window: §0"), words="run.window: should be at least 1, not 0"),
    case("unknown run key", ("  seed: 0", "  §stepps: 5"), words="run.stepps: unknown key (did you mean steps?)"),
    case("run is empty", (VALID[VALID.index("run:") :], "§run:\n"), words="run: should be a mapping, not nothing"),
]

REFERRED = (without("plant:", "observer:"), "plant: plant.yaml\n")
BY_FILE = [
    case("no plant file", (REFERRED[0], "plant: §plnt.yaml\n"), plant=PLANT_FILE, words="(did you mean plant.yaml?)"),
    case("plant is a folder", (REFERRED[0], "plant: §.\n"), words="plant: is not a file"),
    case("plant's name is empty", (REFERRED[0], "plant: §''\n"), words="plant: is not a file"),
    case("wrong entry in the plant file", REFERRED, plant=PLANT_FILE.replace("0.1", "§x"),
         words="plant.A.0.1: should be a number"),
    case("missing key in the plant file", REFERRED, plant="§" + PLANT_FILE.replace("x0: [1.0, 0.0]\n", ""),
         words="plant.x0: is missing"),
    case("wrong shape in the plant file", REFERRED, plant=PLANT_FILE.replace("x0: [", "x0: §[3, "),
         words="plant.x0: should have 2 entries"),
    case("syntax in the plant file", REFERRED, plant=PLANT_FILE.replace("x0: ", "x0: §]"), words="not valid YAML"),
    case("alias in the plant file", REFERRED, plant=PLANT_FILE.replace("x0: ", "x0: §&x "), words="anchors"),
    case("empty plant file", REFERRED, plant="§", words="the file is empty"),
    case("plant file is a list", REFERRED, plant="§[1, 2]\n", words="plant: should be a mapping, not a list"),
    case("plant file names a plant file", REFERRED, plant="§plant.yaml\n", words="should be a mapping, not the text"),
    case("both files", REFERRED, ("steps: 10", "steps: §x"), plant=PLANT_FILE.replace("[heater]", "[§3]"),
         words=("run.steps: should be a whole number", "plant.inputs.0: should be text")),
]

MANY = [
    case("everything at once", ("period: 1.0", "period: §one"), ("[1.0, 0.0]", "§[1.0]"),
         ("method: lmi", "method: §mli"),
         ("C: [[0, 1]]", "C: [§[0, 1, 0]]"), ("[[1, 2]]", "[[1, §3]]"), ("seed: 0", "seed: §-1"),
         words=("plant.period", "plant.x0", "observer.method", "nodes.2.C", "graph.edges.0.1", "run.seed")),
    case("two in one matrix", ("A: [[0.5, 0.1], [0.0, 0.5]]", "A: [[§a, 0.1], [0.0, §b]]"), words=("A.0.0", "A.1.1")),
    case("windows line ends", *[(line + "\n", line + "\r\n") for line in ("name: tiny", "plant:")],
         ("steps: 10", "steps: §x"),
         words="run.steps"),
    case("letters beyond ASCII", ("Two states", "Zwei Zustände 🌡"), ("[heater]\n  E", "[§[]]\n  E"),
         words="plant.inputs.0: should be text, not a list"),
]


def faulty(name: str, faults: str, words: str | tuple[str, ...]) -> Case:
    """The valid file with these faults."""
    return case(name, ("run:", f"faults: {faults}\nrun:"), words=words)


FAULTS = [
    faulty("faults is a number", "§0.1", "faults: should be a mapping, not 0.1"),
    faulty("loss without links", "{§loss: 0.1}", "faults.loss: unknown key"),
    faulty("misspelt links", "{§lnks: [{loss: 0.1}]}", "faults.lnks: unknown key (did you mean links?)"),
    faulty("misspelt loss", "{links: [{§los: 0.1}, {loss: 0.1}]}",
           "faults.links.0.los: unknown key (did you mean loss?)"),
    faulty("loss above 1", "{links: [{loss: §5}]}", "faults.links.0.loss: should be at most 1, not 5"),
    faulty("loss below 0", "{links: [{loss: §-0.1}]}", "faults.links.0.loss: should be at least 0, not -0.1"),
    faulty("loss is text", "{links: [{loss: §5 %}]}", "faults.links.0.loss: should be a number, not the text '5 %'"),
    faulty("a fault that is none", "{links: [§{edges: [[1, 2]]}]}", "faults.links.0: says no fault"),
    faulty("edge that is not there", "{links: [{edges: [[1, 2], §[1, 3]], loss: 0.1}]}",
           "faults.links.0.edges.1: [1, 3] is not an edge of the graph"),
    faulty("faulty edges and arcs", "{links: [{edges: [[1, 2]], §arcs: [[1, 2]], loss: 0.1}]}",
           "give either edges or arcs"),
    faulty("edge with a weight", "{links: [{edges: [§[1, 2, 3]], loss: 0.1}]}", "should have at most 2 entries, not 3"),
    faulty("no edges", "{links: [{edges: §[], loss: 0.1}]}", "faults.links.0.edges: should have at least 1 entry"),
    faulty("during ends before it begins", "{links: [{loss: 0.1, §during: [8, 8]}]}", "should end after it begins"),
    faulty("during begins after the end", "{links: [{loss: 0.1, during: §[10, 12]}, {loss: 0.1, during: [9, 99]}]}",
           "faults.links.0.during: there is no step 10 in a run of 10 steps"),
    faulty("cut after the end", "{cuts: [{edges: [[1, 2]], during: §[20, 30]}]}", "there is no step 20 in a run of 10"),
    faulty("kill after the end", "{nodes: [{node: 1, kill: §10}, {node: 2, kill: 9}]}",
           "faults.nodes.0.kill: there is no step 10 in a run of 10 steps"),
    faulty("pause after the end", "{nodes: [{node: 1, pause: §500, seconds: 1}]}", "pause: there is no step 500"),
    faulty("two delays", "{links: [{delay: {steps: 1, §rounds: 1}}]}", "give either steps or rounds, not both"),
    faulty("delay without a unit", "{links: [{delay: §1}]}", "faults.links.0.delay: should be a mapping, not 1"),
    faulty("empty delay", "{links: [{delay: §{}}]}", "should have one of the keys steps or rounds"),
    faulty("half a step late", "{links: [{delay: {steps: §0.5}}]}", "should be a whole number"),
    faulty("delay backwards", "{links: [{delay: {steps: §[3, 1]}}]}", "should be [least, most], not [3, 1]"),
    faulty("never mends", "{links: [{gilbert_elliott: {worsen: 0.1, mend: §0}}]}", "should be greater than 0, not 0"),
    faulty("half a chain", "{links: [{§gilbert_elliott: {worsen: 0.1}}]}", "gilbert_elliott.mend: is missing"),
    faulty("cut without a time", "{cuts: [§{edges: [[1, 2]]}]}", "should have the key during"),
    faulty("cut without an edge", "{cuts: [§{during: [1, 2]}]}", "should have one of the keys edges or arcs"),
    faulty("kill nobody", "{nodes: [{node: §3, kill: 5}]}",
           "faults.nodes.0.node: no such node: 3; the nodes are 1 and 2"),
    faulty("kill and pause", "{nodes: [{node: 1, kill: 5, §pause: 6}]}", "give either kill or pause, not both"),
    faulty("restart without leave", "{nodes: [{node: 1, restart: §5}]}", "needs run.on_node_loss: restart"),
    faulty("away without a restart", "{nodes: [{node: 1, kill: 5, §away: 6}]}", "belongs to restart"),
    faulty("killed twice", "{nodes: [{node: 1, kill: 5}, {node: 1, kill: §6}]}",
           "node 1 is not there: it is gone from step 5 for good"),
    faulty("pause for how long", "{nodes: [§{node: 1, pause: 5}]}", "pause and seconds belong together"),
    faulty("faulty seed", "{seed: §-1}", "faults.seed: should be at least 0, not -1"),
]

def guarded(name: str, security: str, words: str | tuple[str, ...]) -> Case:
    """The valid file with this security."""
    return case(name, ("run:", f"security: {security}\nrun:"), words=words)


SECURITY = [
    guarded("no such mode", "§tls", "should be 'open', 'password' or 'mtls' or a mapping, not the text 'tls' (did you"),
    guarded("security is true", "§true", "security: should be"),
    guarded("security is a number", "§1", "security: should be"),
    guarded("security is a list", "§[mtls]", "security: should be"),
    case("security without a mode", ("run:", "§security: {keep: true}\nrun:"), words="security.mode: is missing"),
    guarded("no such mode in a mapping", "{mode: §mtsl}", "did you mean mtls?"),
    guarded("misspelt keep", "{mode: mtls, §keeep: true}", "security.keeep: unknown key (did you mean keep?)"),
    guarded("a password in the file", "{mode: password, §password: secret}", "security.password: unknown key"),
    guarded("keep is text", "{mode: mtls, keep: §'yes'}", "security.keep: should be true or false"),
    guarded("exposed with certificates", "{mode: mtls, §exposed: true}", "belongs to the mode open"),
    guarded("keep nothing", "{mode: open, §keep: true}", "an open run has no credentials"),
]

CASES: list[Case] = [
    *SYNTAX, *NUMBERS, *TOP, *PLANT, *DRIVES, *OBSERVER, *NODES, *GRAPH, *RUN, *FAULTS, *SECURITY, *BY_FILE, *MANY
]
