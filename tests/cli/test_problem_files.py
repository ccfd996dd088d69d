"""Problem files and their errors; help that is quick, problems by name, version, completion."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import soup_nlp
from soup_nlp.cli.main import main
from soup_nlp.config.problem import dump_problem, load_problem, make_problem, shipped_problems
from soup_nlp.errors import ConfigError

PROBLEMS = sorted((Path(__file__).resolve().parents[2] / "problems").glob("*.yaml"))
MOTORCYCLE = "input: {kind: motorcycle}\n"


def test_every_shipped_problem_is_one():
    assert all(load_problem(path) for path in PROBLEMS)


@pytest.mark.parametrize("preset", ["null", "paper"])
@pytest.mark.parametrize("path", PROBLEMS[::4], ids=lambda path: path.stem)
def test_a_dumped_problem_is_the_same_problem(path, preset, tmp_path, capsys):
    problem = load_problem(path, [f"preset={preset}"])
    text = dump_problem(problem)
    assert main(["show", str(path), "--set", f"preset={preset}"]) == 0
    for shown in (text, capsys.readouterr().out):
        (tmp_path / "again.yaml").write_text(shown)
        assert load_problem(tmp_path / "again.yaml") == problem
    # all keys are there, so the name of the preset adds nothing
    assert f"preset: {preset}" in text
    (tmp_path / "bare.yaml").write_text(text.replace(f"preset: {preset}", "preset: null"))
    assert load_problem(tmp_path / "bare.yaml").digest() == problem.digest()
    # other readers of YAML understand it too, and every key has its comment
    assert yaml.safe_load(text)["segmentation"]["superpixels"] == problem.segmentation.superpixels
    assert all("  # " in line for line in text.splitlines())


def test_numbers_and_words_are_those_of_yaml_1_2(tmp_path):
    path = tmp_path / "p.yaml"
    path.write_text(f"{MOTORCYCLE}seed: +10\nname: no\nsolver: {{max_seconds: 1e3}}\n")
    problem = load_problem(path)
    assert (problem.seed, problem.name, problem.solver.max_seconds) == (10, "no", 1e3)


ODD = ("!!bool 5", "!!python/name:os.abort", "&b [*b]", "[&b 1, *b]")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("name: x\n", ["missing key", "expected: input"]),
        ("input: {}\n", ["missing key", "expected: input.kind", "try: every input has a kind"]),
        ("input:\n  kind: scene\n", ["missing key", "line 1", "expected: input.scene"]),
        ("input: {kind: movie}\n", ["line 1, key input.kind", "'movie'", "one of files, folder"]),
        ("input: 3\n", ["key input", "found: 3", "a section with keys of its own"]),
        ("input: {kind: scene, scene: stret}\n", ["input.scene", "did you mean street?"]),
        (
            "input: {kind: sintel, root: x, frame: 1, scene: 138}\n",
            ["key input.scene", "found: 138", "write it in quotes"],
        ),
        (
            "input: {kind: files, ref: a, next: b, intrinsics: [1, 2, 3]}\n",
            ["key input.intrinsics", "a list of 4 or more, or a valid string"],
        ),
        (
            MOTORCYCLE + "segmentation:\n  superpixls: 7\n",
            ["unknown key", "line 3, key segmentation.superpixls", "did you mean superpixels?"],
        ),
        (MOTORCYCLE + "superpixels: 3\n", ["did you mean segmentation.superpixels?"]),
        (MOTORCYCLE + "sed: 5\nname: 3\n", ["(and 1 more mistake)"]),
        (MOTORCYCLE + "seed: 1\nseed: 2\n", ["given twice", "line 3", "found: seed"]),
        ("- 1\n", ["must be a mapping", "found: list"]),
        ("a: [\n", ["not YAML", "line 2"]),
        *((f"a: {value}\n", ["not YAML", "an alias (*name) or a tag", "line 1"]) for value in ODD),
        (MOTORCYCLE + "seed: 010\n", ["key seed", "found: '010'", "a valid integer"]),
        (MOTORCYCLE + f"seed: {'9' * 5000}\n", ["key seed", "a valid integer"]),
    ],
)
def test_an_error_says_where_it_is_and_what_was_expected(text, parts, tmp_path):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_problem(path)
    for part in [str(path), *parts]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("solver.max_itr=3", ["unknown key", "solver.max_itr", "did you mean max_iter?"]),
        ("solver.max_iter=many", ["solver.max_iter", "'many'", "integer"]),
        ("solver.max_iter=-1", ["greater than or equal to 0"]),
        ("formulation.gauge=unit_offset", ["unit-offset", "did you mean unit-offset?"]),
        ("solver.eps=[1, -1]", ["--set solver.eps", "key solver.eps"]),
        ("segmentation.boundary_samples=none", ["a valid integer, or all"]),
        ("input.kind.x=3", ["goes below a value", "kind is a section"]),
        ("energy.weights.proj=-1", ["energy.weights.proj"]),
        ("segmentation.superpixels=0", ["segmentation.superpixels"]),
        ("nonsense", ["override is not key=value", "--set"]),
        ("seed=[1", ["not YAML", "--set seed=[1"]),
    ],
)
def test_an_override_is_checked_like_the_file(override, parts):
    with pytest.raises(ConfigError) as caught:
        make_problem({"input": {"kind": "motorcycle"}}, [override])
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize("key", ["hsllib", "pardisolib", "option_file_name", "output_file"])
def test_a_file_names_no_library_of_ipopt(key, tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(f"{MOTORCYCLE}solver: {{ipopt: {{{key}: ./evil.so}}}}")
    for overrides in ([], [f"solver.ipopt.{key}=mine.so"]):
        with pytest.raises(ConfigError, match=rf"library[\s\S]*{key}[\s\S]*--set solver.ipopt"):
            load_problem(path, overrides)
    path.write_text(MOTORCYCLE)
    assert load_problem(path, [f"solver.ipopt.{key}=mine.so"]).solver.ipopt == {key: "mine.so"}


def test_a_text_of_digits_needs_no_quotes_on_the_command_line(tmp_path):
    raw = {"input": {"kind": "kitti2015", "root": "."}}
    for text in ("000138", "138", '"000138"'):
        assert int(make_problem(raw, [f"input.index={text}"]).input.index) == 138
    (tmp_path / "a.yaml").write_text("input: {kind: kitti2012, root: ., index: 000138}")
    assert load_problem(tmp_path / "a.yaml").input.index == "000138"
    raw = {"input": {"kind": "vkitti1", "root": ".", "frame": 1}}
    assert make_problem(raw, ["input.scene=0001"]).input.scene == "0001"
    (tmp_path / "a.yaml").write_text("input: {kind: vkitti1, root: ., frame: 1, scene: 0001}")
    assert load_problem(tmp_path / "a.yaml").input.scene == "0001"
    with pytest.raises(ConfigError, match="in quotes"):
        make_problem({**raw, "input": {**raw["input"], "scene": 1}})
    # where a list would do as well
    with pytest.raises(ConfigError, match="list"):
        make_problem({"input": {"kind": "files", "ref": "a", "next": "b"}}, ["input.intrinsics=5"])


def test_show_prints_what_users_turn_and_what_differs(capsys):
    assert main(["show", "street", "--set", "energy.weights.cont=0.5"]) == 0
    short = capsys.readouterr().out
    assert "superpixels: 1000" in short
    assert "cont: 0.5" in short
    assert "leak_arap" not in short
    assert main(["show", "street", "--set", "energy.weights.cont=0.5", "--all"]) == 0
    whole = capsys.readouterr().out
    assert "leak_arap" in whole
    one, other = (make_problem(yaml.safe_load(text)) for text in (short, whole))
    assert one.digest() == other.digest()


# --- what a new user meets first ------------------------------------------------------------------


ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "scipy", "cv2", "casadi", "matplotlib", "skimage")


HELP = """from soup_nlp.cli.main import main
for words in (['--help'], ['--version']): main(words)"""
ON_USE = ("matplotlib", "trimesh", "pandas", "skimage.segmentation", "scipy.stats")


@pytest.mark.parametrize(
    ("code", "absent"),
    [(HELP, HEAVY), pytest.param("import soup_nlp.cli.solve", ON_USE, marks=pytest.mark.slow)],
)
def test_libraries_are_imported_on_use(code, absent):
    code += f"\nimport sys; print([m for m in {absent} if m in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    if absent is HEAVY:
        assert f"soup-nlp {soup_nlp.__version__}" in done.stdout
        assert "compare" in done.stdout


def test_a_version_has_its_changelog_and_citation():
    changes, citation = ((ROOT / name).read_text() for name in ("CHANGELOG.md", "CITATION.cff"))
    released = re.findall(r"^## \[(\d.*?)\] - \d{4}-\d\d-\d\d$", changes, re.MULTILINE)[0]
    (cited,) = re.findall(r"^version: (.*)$", citation, re.MULTILINE)
    assert released == cited == soup_nlp.__version__


def test_public_names_are_there_after_any_import():
    assert all(hasattr(soup_nlp, name) for name in soup_nlp.__all__)
    assert soup_nlp.__all__ == dir(soup_nlp)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        soup_nlp.nothing  # noqa: B018


def test_problems_are_found_by_name_anywhere(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert set(shipped_problems()) == {p.stem for p in (ROOT / "problems").glob("*.yaml")}
    assert load_problem("street").input.scene == "street"
    # files that such a problem reads are in the user's folder, not in the package's
    assert load_problem("folder", ["input.path=mine"]).path("mine") == tmp_path / "mine"
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in shipped_problems())
    with pytest.raises(ConfigError, match="did you mean street"):
        load_problem("stret")
    (tmp_path / "street").write_text("input: {kind: motorcycle}\n")
    # a file of that name is meant first
    assert load_problem("street").input.kind == "motorcycle"


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("so", "solve"),
        ("solve moto", "motorcycle"),
        ("convert out --to ply,col", "ply,colmap"),
        ("show street --preset pa", "paper"),
    ],
)
def test_completion_knows_commands_problems_and_formats(line, word, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["soup-nlp"])
    # a program of its own, not `python -m pytest`
    monkeypatch.setattr("__main__.__package__", None)
    words = {"COMP_WORDS": f"soup-nlp {line}", "COMP_CWORD": str(len(line.split()))}
    for name, value in (words | {"_SOUP_NLP_COMPLETE": "complete_bash"}).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main()
    assert capsys.readouterr().out.split() == [word]
