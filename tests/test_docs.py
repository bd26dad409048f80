"""Pages and README: their code runs, their commands parse, their links and names exist."""

import ast
import importlib.util
import inspect
import json
import pathlib
import re
import shlex
import sys
import types
import typing

import jax
import numpy as np
import pytest
import scipy.special
import tiny

from vawm import __main__ as front_door
from vawm import envs, policy
from vawm.agent import make_agent, plugins, registry
from vawm.cli import command_line, flags
from vawm.envs import probes
from vawm.runs import runner, suites, validate

ROOT = pathlib.Path(__file__).parents[1]
DOCS, README = ROOT / "docs", ROOT / "README.md"
PAPER = DOCS / "paper.md"
PAGES = sorted(DOCS.rglob("*.md"))
TEXTS = {str(path.relative_to(ROOT)): path.read_text() for path in [README, *PAGES]}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
OTHERS_FLAGS = {"--help", "--plugin"}  # of every program


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # where dataclasses look their types up
    spec.loader.exec_module(module)
    return module


ROWS = dict(registry._ROWS)
PROGRAMS = {path.stem: load(path) for path in (ROOT / "experiments").rglob("*.py")}
WITH_OWN = dict(registry._ROWS)  # with what a program has registered
registry._ROWS.clear()
registry._ROWS.update(ROWS)  # other tests of this process know no more than the package
PROGRAMS |= {  # those of the package, `python -m` and `vawm`
    door.module: importlib.import_module(door.module) for door in front_door.PROGRAMS.values()
}
PROGRAMS |= {
    f"vawm.{path.stem}": importlib.import_module(f"vawm.{path.stem}")
    for path in (ROOT / "vawm").glob("*.py")
    if "\ndef main(" in path.read_text()
}


def options(program):
    """The dataclass that a program reads its flags into; None for a training run."""
    program = sys.modules[program.main.__module__]  # behind a thin door
    source = inspect.getsource(program)
    found = re.search(r"flags\w*\.read\((\w+),", source)
    if found:
        return getattr(program, found[1])
    shared = re.search(r"(ablation|costs)\.main\(", source)  # that of all ablations
    return getattr(program, shared[1]).Options if shared else None


OPTIONS = {name: options(program) for name, program in PROGRAMS.items()}
gen_reference = load(DOCS / "gen_reference.py")


def blocks(text, language):
    return [code for name, code in FENCE.findall(text) if name == language]


def prose(text):
    """A page without its blocks of code."""
    return FENCE.sub("", text)


def configs():
    for of_suite in (registry.kind(name).presets for name in registry.names()):
        for of_name in of_suite.values():
            yield from of_name.values()


def known_flags():
    """Flag -> what it may be, over all agents and suites."""
    kinds = {}
    for config in configs():
        for flag, kind in flags.known(command_line.Flags, command_line.Flags(config)).items():
            kinds.setdefault(flag, []).append(kind)
    return kinds


FLAGS = known_flags()
FIELDS = {flag.removeprefix("--").replace("-", "_"): kinds for flag, kinds in FLAGS.items()}
ALL_FLAGS = set(FLAGS).union(*(flags.known(cls) for cls in OPTIONS.values() if cls))
ALL_FLAGS |= OTHERS_FLAGS | {"--game"}


# Code


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """A folder with a run in it; training is checked and left out, the policy is untrained."""
    (tmp_path / "LOGDIR").mkdir()
    line = json.dumps({"env_steps": 16, "episode/return": None})
    (tmp_path / "LOGDIR" / "metrics.jsonl").write_text(line + "\n")
    monkeypatch.chdir(tmp_path)
    trained = []

    def run(config, logdir, *, env=None):
        runner.check(config, pathlib.Path(logdir), resume=False, known_task=env is None)
        if env is not None:
            assert env.spec.num_envs == config.num_envs
            assert env.spec.action_repeat == config.action_repeat
        trained.append(config.task)
        return runner.Result(pathlib.Path(logdir), config.env_steps, 0)

    def load_policy(logdir):
        spec = tiny.env().spec
        agent = make_agent(tiny.CONFIG, spec)
        params, state = jax.jit(agent.init)(jax.random.key(0))
        act = jax.jit(agent.act, static_argnames="how")
        return policy.Policy(tiny.CONFIG, spec, 0, params, state, agent.initial, act)

    def make(task, *, num_envs, action_repeat):
        assert (task, action_repeat) == (tiny.CONFIG.task, tiny.CONFIG.action_repeat)
        return probes.make("observation_action", num_envs=num_envs)

    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))
    monkeypatch.setattr(runner, "run", run)
    monkeypatch.setattr(policy, "load", load_policy)
    monkeypatch.setattr(envs, "make", make)
    return trained


ELSEWHERE = ("train.over_seeds", "gymnasium.make_vec")  # run by test_pendulum.py
SNIPPETS = {
    f"{path.stem}-{i}": code
    for path in PAGES
    for i, code in enumerate(blocks(path.read_text(), "python"))
    if not any(name in code for name in ELSEWHERE)
}


@pytest.mark.parametrize("name", SNIPPETS)
def test_the_code_of_a_page_runs(name, stage):
    exec(SNIPPETS[name], {"__name__": "__main__"})
    assert len(stage) == SNIPPETS[name].count("runner.run(")


def test_the_losses_of_the_readme_run_as_they_stand():
    [code] = [code for code in blocks(TEXTS["README.md"], "python") if "losses." in code]
    names = {}
    exec(code, names)
    value, prior = (
        scipy.special.log_softmax(np.asarray(names[name], np.float64), axis=-1)
        for name in ("value_logits", "prior_value_logits")
    )
    loss = 0.6 * (np.exp(value) * (value - prior)).sum(-1)
    assert names["loss"] == pytest.approx(loss, rel=1e-5)
    assert names["weight"].tolist() == pytest.approx([1 / 3] * 8)
    assert names["total"] == pytest.approx(loss.mean() / 3)


def test_the_losses_of_the_guide_leave_the_critic_alone():
    names = {}
    exec(SNIPPETS["losses-0"], names)
    inferred, predicted = names["gradient"]
    assert names["value"] > 0
    assert abs(inferred).sum() > 0
    assert abs(predicted).sum() > 0
    to_critic = jax.grad(names["alignment"], argnums=1)(
        (names["inferred"], names["predicted"]),
        names["critic_params"],
        names["latent_kl"],
        jax.numpy.array(20_000),
    )
    assert all((leaf == 0).all() for leaf in jax.tree.leaves(to_critic))


def test_the_environment_of_the_guide_keeps_the_stream(stage):
    names = {}
    exec(SNIPPETS["environment-0"], names)
    env, step = names["env"], jax.jit(names["env"].step)
    state, timestep = jax.jit(env.reset)(jax.random.key(0))
    firsts, lasts = [timestep.is_first], [timestep.is_last]
    for _ in range(2 * names["LENGTH"] + 1):
        state, timestep = step(state, jax.numpy.ones((names["N"], 1)))
        firsts.append(timestep.is_first)
        lasts.append(timestep.is_last)
        assert (timestep.reward[timestep.is_first] == 0).all()
    firsts, lasts = jax.numpy.stack(firsts), jax.numpy.stack(lasts)
    assert jax.numpy.nonzero(firsts.all(1))[0].tolist() == [0, 51]
    assert jax.numpy.nonzero(lasts.all(1))[0].tolist() == [50, 101]
    assert firsts.sum() == lasts.sum() == 2 * names["N"]


def test_the_readme_has_at_most_150_lines_of_120_characters():
    lines = TEXTS["README.md"].splitlines()
    assert len(lines) <= 150
    assert max(map(len, lines)) <= 120


def test_the_readme_lists_every_suite_with_the_presets_of_every_agent():
    rows = re.findall(
        r"^\|.*`python experiments/(\w+)\.py.*?\|(.*)\|$", TEXTS["README.md"], re.M
    )
    assert "| suite | command | dreamerv3 | storm | vagram |" in TEXTS["README.md"]
    told = {
        program.removesuffix("_task"): [cell.strip().split(", ") for cell in cells.split("|")]
        for program, cells in rows
    }
    assert told.keys() == registry.kind("dreamerv3").presets.keys()
    for suite, cells in told.items():
        agents = ("dreamerv3", "storm", "vagram")
        assert cells == [list(registry.kind(agent).presets[suite]) for agent in agents]


# Commands and flags


def commands(text):
    """Words of every command that starts one of our programs: (program, arguments)."""
    lines = "\n".join(blocks(text, "bash")).splitlines()
    lines += re.findall(r"`((?:python|vawm) [^`]+)`", prose(text))
    for line in lines:
        for part in line.replace("\n", " ").split("&&"):
            words = shlex.split(part, comments=True)
            if words[:1] == ["python"] and words[1:] != [] and words[1] != "-c":
                yield tuple(words[2:] if words[1] == "-m" else words[1:])
            if words[:1] == ["vawm"]:
                yield tuple(words)


COMMANDS = sorted({command for text in TEXTS.values() for command in commands(text)})


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_command_is_one_that_would_start(command, monkeypatch):
    program, *argv = command
    given = {}
    if program == "vawm" and argv[:1] == ["train"]:
        program, given, argv = "vawm.cli.train", {"suite": argv[1]}, argv[2:]
    elif program == "vawm" and argv and argv[0] in front_door.PROGRAMS:
        program, argv = front_door.PROGRAMS[argv[0]].module, argv[1:]
    elif program == "vawm":
        assert front_door.main(argv) == 0
        return
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setattr(registry, "_ROWS", WITH_OWN)
    program = pathlib.Path(program).stem if "/" in program else program
    if OPTIONS[program]:
        for flag in ("--logdir", "--logdirs"):
            if flag[2:] in OPTIONS[program].__dataclass_fields__ and flag not in argv:
                argv += [flag, "LOGDIR"]
        flags.read(OPTIONS[program], argv)
        return

    def check(argv, **choices):
        if "--resume" in argv:  # of a run that is not here
            argv = [word for word in argv if word != "--resume"]
        parsed = command_line.parse(argv, **choices)
        validate.check(parsed.config)
        suites.check_task(parsed.config)

    if given:
        check(argv, **given)
        return
    monkeypatch.setattr(command_line, "train", check)
    main = PROGRAMS[program].main
    if not argv and not inspect.signature(main).parameters:
        return  # one without flags, which has a test of its own
    main(argv)


def test_every_flag_of_every_program_has_a_sentence():
    said = [
        flags.sentences(command_line.Flags, command_line.Flags(config)) for config in configs()
    ]
    said += [flags.sentences(cls) for cls in OPTIONS.values() if cls]
    assert len(said) > 20
    assert not {flag for of_one in said for flag, text in of_one.items() if not text}


@pytest.mark.parametrize("page", TEXTS)
def test_every_flag_that_is_mentioned_exists(page):
    text = re.sub(r"^\|[-| ]+\|$", "", TEXTS[page], flags=re.MULTILINE)  # lines of tables
    text = re.sub(r"(pip|apt-get|ruff) [^`\n]*", "", text)
    mentioned = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*(?:\w|\*)", text))
    groups = {flag.removesuffix("*") for flag in mentioned if flag.endswith("*")}
    unknown = {flag for flag in mentioned if not flag.endswith("*")} - ALL_FLAGS
    unknown |= {x for x in groups if not any(flag.startswith(x) for flag in ALL_FLAGS)}
    assert not unknown


# Links


def slugs(text):
    """Anchors of the headings of a page."""
    titles = re.findall(r"^#+ (.*)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", "-") for title in titles}


def leads_somewhere(page, target):
    path, _, anchor = target.partition("#")
    here = (ROOT / page).parent
    file = (here / path).resolve() if path else ROOT / page
    if file.is_relative_to(DOCS) and not file.exists():
        generated = str(file.relative_to(DOCS))
        return generated in {*gen_reference.pages(), "notebooks.md"} and not anchor
    return file.exists() and (not anchor or anchor in slugs(file.read_text()))


@pytest.mark.parametrize("page", TEXTS)
def test_every_internal_link_leads_somewhere(page):
    targets = re.findall(r"\]\(([^)\s]+)\)", prose(TEXTS[page]))
    inside = [target for target in targets if not re.match(r"https?://", target)]
    assert not [target for target in inside if not leads_somewhere(page, target)]


@pytest.mark.parametrize("page", TEXTS)
def test_every_reference_names_something_of_the_package(page):
    for name in set(re.findall(r"\]\[([\w.]+)\]", prose(TEXTS[page]))):
        found, rest = __import__("vawm"), name.split(".")[1:]
        assert name.startswith("vawm")
        for part in rest:
            found = getattr(found, part)


# The page about the paper


def rows():
    """Cells of every row of the page's tables whose last column is the switch."""
    for table in re.findall(r"(?:^\|.*\n)+", PAPER.read_text(), re.MULTILINE):
        head, _, *lines = (line.strip("| ").split(" | ") for line in table.splitlines())
        if head[-1] == "Switch":
            yield from ((len(head), cells) for cells in lines)


def is_choice(text):
    """Whether `field` or `field=value` is something that a config can say."""
    name, has_value, value = text.partition("=")
    if not has_value:
        return name in FIELDS
    if name not in FIELDS:
        return False
    literals = [kind for kind in FIELDS[name] if typing.get_origin(kind) is typing.Literal]
    if literals:
        return any(value in typing.get_args(kind) for kind in literals)
    return value in ("True", "False") if bool in FIELDS[name] else float(value) is not None


def test_every_row_about_the_paper_says_what_switches_it():
    assert len(list(rows())) > 50
    for columns, cells in rows():
        assert len(cells) == columns, cells
        switches = re.findall(r"`([^`]+)`", cells[-1])
        assert switches or "no switch" in cells[-1], cells
        for switch in switches:
            assert switch in ALL_FLAGS if switch.startswith("--") else is_choice(switch), cells


@pytest.mark.parametrize("page", TEXTS)
def test_every_config_field_that_is_mentioned_exists(page):
    parts = {name.partition(".")[0] for name in FIELDS if "." in name}
    names = re.findall(rf"`((?:{'|'.join(parts)})\.\w+)(?:=[^`]*)?`", prose(TEXTS[page]))
    files = (".mp4",)  # a part may be called as a file is
    assert not {name for name in names if name not in FIELDS and not name.endswith(files)}


# The reference


def test_every_module_has_a_page_of_reference_and_a_place_in_the_navigation():
    files = [path for path in (ROOT / "vawm").rglob("*.py") if path.read_text().strip()]
    modules = (".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files)
    pages = gen_reference.pages()
    assert sorted(pages.values()) == sorted(m.removesuffix(".__init__") for m in modules)

    def leaves(entries):
        for entry in entries:
            for value in entry.values():
                yield from leaves(value) if isinstance(value, list) else [value]

    assert sorted(leaves(gen_reference.navigation())) == sorted(pages)


def test_no_docstring_has_words_that_html_would_swallow():
    for path in (ROOT / "vawm").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
                continue
            lines = inspect.cleandoc(str(node.value.value)).splitlines()
            text = "\n".join(line for line in lines if not line.startswith("    "))
            found = re.findall(r"<[a-zA-Z/][^\s>]*>", re.sub(r"`[^`]*`", "", text))
            assert not found, (path, node.lineno, found)


def test_the_page_of_a_notebook_has_all_of_its_text_code_and_outputs():
    for path in gen_reference.notebooks():
        page = gen_reference.notebook_page(path)
        assert page.startswith("# ")
        assert f"({path.name})" in page
        kinds = [kind for kind, _ in gen_reference.cells(path)]
        assert page.count("```python\n") == kinds.count("code") > 3
        assert all(text in page for _, text in gen_reference.cells(path))
        stored = gen_reference.outputs(path)
        assert len(stored) == kinds.count("code")
        drawn = [name for output in stored for name in output["drawn"]]
        assert page.count("![") == len(drawn) > 0
        for name in drawn:
            assert (gen_reference.OUTPUTS / path.stem / name).exists()
        assert all("\n".join(output["printed"]) in page for output in stored)
        assert {f"notebooks/{path.stem}.md"} <= set().union(
            *map(dict.values, gen_reference.notebook_links())
        )
        assert f"notebooks/{path.stem}.md" in gen_reference.list_notebooks()


def test_links_to_files_of_results_lead_to_the_copies_of_the_site():
    page = types.SimpleNamespace(file=types.SimpleNamespace(src_uri="results/speed.md"))
    text = "[a](../../experiments/results/a.md) ![b](../../experiments/results/b.png)"
    moved = gen_reference.on_page_markdown(text, page=page)
    assert moved == "[a](files/a.md) ![b](files/b.png)"


def test_names_of_code_in_tables_may_break():
    html = "<p><code>a.b</code></p><td><code>a.b_c=1</code> x.y</td>"
    expected = "<p><code>a.b</code></p><td><code>a.<wbr>b_<wbr>c=<wbr>1</code> x.y</td>"
    assert gen_reference.on_page_content(html) == expected


def test_ci_builds_the_site_as_the_page_says():
    """The block after the marker, which `.ci/run` runs."""
    (found,) = re.findall(
        r"<!-- docs command -->\n```bash\n(.*?)```", TEXTS["docs/index.md"], re.S
    )
    install, build = found.splitlines()
    assert install.startswith("pip install -c constraints.txt -e ")
    assert build == "mkdocs build"
    assert "strict: true" in (ROOT / "mkdocs.yml").read_text()
    assert 'block "docs command" docs/index.md' in (ROOT / ".ci" / "run").read_text()
