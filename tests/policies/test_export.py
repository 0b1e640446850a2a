"""``pickplace-export``: onnxruntime against the network read cell by cell, and against the planner's choices."""

import json
import sys
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_footprint_fcn import by_hand, random_maps
from torch.export import Dim

from pickplace import CellSpec, PickPlaceEnv, __version__, load_policy
from pickplace.policies import onnx_model
from pickplace.policies.afterstate.policy import AfterstateFcn
from pickplace.policies.base import MASKED
from pickplace.policies.fcn4d.policy import Fcn4d
from pickplace.policies.fcn_grasp.policy import FcnGrasp
from pickplace.policies.onnx_model import Scores, shapes_of
from pickplace.rules.item import item_from_depth
from pickplace.rules.masks import footprint_mask, placing_maps
from pickplace.rules.reach.annulus import Annulus
from pickplace.rules.state import State
from pickplace.rules.support.rules import Bearing

MAKERS = {
    "fcn_grasp": lambda: FcnGrasp(CellSpec(), head_std=1.0, compute_dtype="float32"),
    "fcn4d": lambda: Fcn4d(CellSpec(rotations=3), filters=4, head_std=1.0, compute_dtype="float32"),
}


@pytest.mark.parametrize("name", MAKERS)
def test_torch_export_takes_any_size(name):
    """No size of the example is a constant of the program."""
    torch.manual_seed(0)
    policy = MAKERS[name]()
    scores = Scores(policy, policy.map_keys)
    maps = [
        part[: len(policy.map_keys)] for part in (random_maps(0, 2, (5, 6), (7, 9)), random_maps(1, 3, (6, 4), (5, 8)))
    ]
    shapes = tuple(dict(enumerate(shapes_of(policy)[key])) for key in policy.map_keys)
    program = torch.export.export(scores, tuple(maps[0]), dynamic_shapes=(shapes,)).module()
    for example in maps:
        torch.testing.assert_close(program(*example), scores(*example), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("patch", "bin_items", "preview"), [
    (2, 1, 0), (1, 2, 3), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((1, 1, 0), (1, 2, 0), (1, 1, 3))),
])  # fmt: skip
def test_torch_export_of_values_takes_any_tote(patch, bin_items, preview):
    torch.manual_seed(0)
    cell = CellSpec(support=Bearing(), bin_items=bin_items, longest_side=3, preview=preview)
    policy = AfterstateFcn(cell, patch=patch, stem=4, filters=8, compute_dtype="float32")
    torch.nn.init.normal_(policy.network.head.weight, std=3)
    torch.nn.init.normal_(policy.network.waiting.sum.weight, std=0.1)
    keys = [key for key in policy.in_keys if not key.endswith("_mask")]
    examples = []
    for count, tote in ((2, (7, 9)), (3, (5, 8)), (4, (8, 6))):
        maps, height = random_maps(count, count, (5, 5), tote), torch.full((count, 1), 8)
        tables = {"items": torch.randint(1, 4, (count, 2, 5)), "coming": torch.randint(1, 4, (count, 1 + count, 5))}
        examples.append((*maps, height, *(table for key, table in tables.items() if key in keys)))
    shapes = tuple(dict(enumerate(shapes_of(policy)[key])) for key in keys)
    scores = Scores(policy, keys)
    scores(*examples[0])
    program = torch.export.export(scores, examples[0], dynamic_shapes=(shapes,)).module()
    for example in examples:
        expected = scores(*example)
        assert expected.std() > 100
        torch.testing.assert_close(program(*example), expected, rtol=1e-5, atol=1e-2)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """``pretrained/mixed_grasp`` in onnxruntime, what the export says of its check, and its converted network."""
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    path, programs, convert = tmp_path_factory.mktemp("onnx") / "mixed.onnx", [], onnx_model._convert

    def keep(*given):
        programs.append(convert(*given))
        return programs[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_model, "_convert", keep)
        differences = onnx_model.export_onnx("pretrained/mixed_grasp", path)
    (program,) = programs
    return runtime.InferenceSession(path, providers=["CPUExecutionProvider"]), differences, program


@pytest.fixture
def converted(exported, monkeypatch):
    """Exports of ``pretrained/mixed_grasp`` begin with its converted network, which takes seconds to make."""
    monkeypatch.setattr(onnx_model, "_convert", lambda *given: exported[2])


def test_the_check_is_at_three_sizes_that_the_export_has_not_seen(exported):
    session, differences, _ = exported
    assert len(differences) == 3 and (8, 8) not in differences and 0 < max(differences.values()) <= 1e-5
    facts = session.get_modelmeta().custom_metadata_map
    assert (facts["pickplace"], facts["checkpoint"], facts["policy"]) == (
        __version__,
        "pretrained/mixed_grasp",
        "FcnGrasp",
    )
    assert json.loads(facts["cell"])["tote_size"] == [8, 8, 8] and facts["index"].startswith(
        "(quarter_turned * W_T + x) * D_T + y"
    )
    shapes = {entry.name: entry.shape for entry in session.get_inputs()}
    assert shapes == {
        "bin_depth": ["N", "W_B", "D_B"], "tote_depth": ["N", "W_T", "D_T"], "tote_bearing": ["N", "W_T", "D_T"]
    }  # fmt: skip


def test_torch_export_takes_any_number_of_items():
    seen = [PickPlaceEnv(num_envs=3, bin_items=count, **sizes).reset() for count, sizes in (
        (2, {"bin_size": (5, 6, 1), "tote_size": (7, 9, 5)}), (4, {"bin_size": (6, 4, 1), "tote_size": (5, 8, 5)}),
    )]  # fmt: skip
    torch.manual_seed(0)
    policy = FcnGrasp(CellSpec(bin_items=2), head_std=1.0, compute_dtype="float32")
    scores = Scores(policy, [key for key in policy.in_keys if not key.endswith("_mask")])
    examples = [tuple(each[key] for key in scores.keys) for each in seen]
    shapes = tuple(dict(enumerate(shapes_of(policy).get(key, ("N", Dim.AUTO, Dim.AUTO)))) for key in scores.keys)
    program = torch.export.export(scores, examples[0], dynamic_shapes=(shapes,)).module()
    for example in examples:
        torch.testing.assert_close(program(*example), scores(*example), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("weights", ["mixed", pytest.param("mixed_grasp", marks=pytest.mark.slow)])
def test_several_items_are_an_input(weights, tmp_path):
    """Each item's part of the scores; with more or fewer items than in training, too."""
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    path = tmp_path / "several.onnx"
    onnx_model.export_onnx(f"pretrained/{weights}", path, bin_items=3)
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert {entry.name: entry.shape for entry in session.get_inputs()}["items"] == ["N", "M", 5]
    for count in (2, 4):
        trained = onnx_model._load(f"pretrained/{weights}", (), bin_items=count, tote_size=(7, 9, 5))
        seen = trained.make_env(num_envs=3).rollout(4, trained, break_when_any_done=False).reshape(-1)
        keys = [entry.name for entry in session.get_inputs()]
        (found,) = session.run(None, {key: seen[key].numpy() for key in keys})
        with torch.no_grad():
            expected = trained.policy.unmasked_scores(seen)
        assert found.shape == (len(seen), trained.cell.num_choices)
        torch.testing.assert_close(torch.from_numpy(found), expected, rtol=1e-4, atol=1e-3)


def test_a_robot_with_a_reach_has_the_same_scores(converted, tmp_path):
    """The network that was converted without a reach has these scores."""
    reach = Annulus((0, 99), (0, 9), (0, 0, 0), (0, 0, 0))
    assert max(onnx_model.export_onnx("pretrained/mixed_grasp", tmp_path / "reach.onnx", reach=reach).values()) <= 1e-5


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    batch=st.integers(1, 3),
    bin_size=st.tuples(st.integers(4, 6), st.integers(4, 6)),
    tote=st.tuples(st.integers(3, 14), st.integers(3, 14)),
)
def test_any_size_is_what_a_person_would_read_off_the_maps(exported, seed, batch, bin_size, tote):
    """Against plain Python; and the index of a score is that of its corner."""
    maps = random_maps(seed, batch, bin_size, tote)
    keys = ("bin_depth", "tote_depth", "tote_bearing")
    (logits,) = exported[0].run(["logits"], {key: part.numpy() for key, part in zip(keys, maps, strict=True)})
    assert logits.shape == (batch, 2 * tote[0] * tote[1])
    network, item = load_policy("pretrained/mixed_grasp").policy.network, item_from_depth(maps[0])
    row, quarter_turned = batch - 1, seed % 2
    w, d, h = (int(part[row]) for part in item[2:5])
    wide, deep = (d, w) if quarter_turned else (w, d)
    if wide <= tote[0] and deep <= tote[1]:
        x, y = (tote[0] - wide) // 2, tote[1] - deep
        expected = by_hand(network, (w, d, h), maps[1][row], maps[2][row], quarter_turned, x, y)
        assert logits[row, (quarter_turned * tote[0] + x) * tote[1] + y] == pytest.approx(
            expected.item(), rel=1e-4, abs=1e-4
        )


def test_its_best_feasible_footprint_is_the_planners(exported):
    trained = load_policy("pretrained/mixed_grasp", tote_size=(7, 9, 6))
    trained.policy.network.compute_dtype = "float32"
    seen = trained.make_env(num_envs=8).rollout(10, trained, break_when_any_done=False).reshape(-1)
    keys = [entry.name for entry in exported[0].get_inputs()]
    logits = torch.from_numpy(exported[0].run(None, {key: seen[key].numpy() for key in keys})[0])
    maps = placing_maps(trained.cell, State.from_observation(seen))
    mask = footprint_mask(trained.cell, maps).flatten(1)
    best = torch.where(mask, logits, MASKED).argmax(1)
    assert torch.equal(best, trained.policy.to_choice(trained.policy.best_feasible(seen, maps), seen))


@pytest.fixture
def command(run):
    return partial(run, "export")


def test_the_command_replaces_a_file_when_the_check_has_passed(converted, command, tmp_path, monkeypatch):
    (tmp_path / "mixed.onnx").write_text("old")
    with monkeypatch.context() as patch:
        patch.setattr(onnx_model, "TOLERANCE", -1.0)
        code, out, err = command("pretrained/mixed_grasp", "mixed.onnx")
    assert code == 2 and "at a tote of 9x12 cells onnxruntime and torch differ by" in err and err.count("\n") == 1
    (path,) = tmp_path.iterdir()
    assert path.name == "mixed.onnx" and path.read_text() == "old"
    code, out, err = command("pretrained/mixed_grasp", "mixed.onnx")
    assert (code, err) == (0, "") and out.startswith(
        "mixed.onnx: onnxruntime agrees with torch at totes of 9x12, 11x8, 15x13"
    )
    assert [*tmp_path.iterdir()] == [path] and path.stat().st_size > 10**5


def test_the_scores_of_flat_actions_are_those_of_the_policy():
    torch.manual_seed(0)
    policy = MAKERS["fcn4d"]()
    seen = PickPlaceEnv(num_envs=3, tote_size=(8, 7, 5), rotations=3).reset()
    policy = policy.with_cell(CellSpec(tote_size=(8, 7, 5), rotations=3))
    with torch.no_grad():
        scores = Scores(policy, policy.map_keys)(*(seen[key] for key in policy.map_keys))
        torch.testing.assert_close(scores.log_softmax(1), policy.action_log_probs(seen))


@pytest.mark.slow
def test_fcn4d_scores_every_flat_action(tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    onnx_model.export_onnx("pretrained/paper", tmp_path / "fcn4d.onnx", rotations=3)
    trained = load_policy("pretrained/paper", tote_size=(8, 7, 5), rotations=3)
    trained.policy.network.compute_dtype = "float32"
    seen = trained.make_env(num_envs=3).reset()
    session = runtime.InferenceSession(tmp_path / "fcn4d.onnx", providers=["CPUExecutionProvider"])
    (logits,) = session.run(None, {key: seen[key].numpy() for key in ("bin_depth", "tote_depth")})
    expected = trained.policy.action_log_probs(seen)
    torch.testing.assert_close(torch.from_numpy(logits).log_softmax(1), expected, rtol=1e-4, atol=1e-3)
    assert logits.shape == (3, trained.cell.num_actions)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["pretrained/unmasked", "x.onnx"],
            "pretrained/unmasked: UnmaskedFcnGrasp has no scores for totes of any size",
        ),
        (["pretrained/gopt_rs", "x.onnx"], "pretrained/gopt_rs: Afterstate has no scores for totes of any size"),
        (["pretrained/r4", "nowhere/x.onnx"], "nowhere/x.onnx: expected a file in a folder that exists"),
        (["pretrained/r4", "."], "expected a file in a folder that exists"),
        (["pretrained/none", "x.onnx"], "expected pretrained/cdrl_rs"),
        (["pretrained/r1", "x.onnx", "--rotations", "4"], "env.rotations=4: the checkpoint was trained with 1"),
        (["pretrained/r4"], "required: file"),
    ],
)
def test_the_command_refuses_in_one_sentence(command, tmp_path, arguments, message):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    code, out, err = command(*arguments)
    assert (code, out) == (2, "") and err.startswith("error: ") and err.count("\n") == 1 and message in err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_extra_is_one_sentence(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, out, err = command("pretrained/r4", "x.onnx")
    assert (code, out) == (2, "")
    assert err == "error: pickplace-export: onnx is missing; pip install 'pickplace[onnx]'.\n"


@pytest.mark.slow
def test_values_on_a_fine_grid_are_checked_at_a_few_problems(tmp_path):
    """Items of up to 10 cells, whose hulls bear weight, in totes of 30x20 cells."""
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    differences = onnx_model.export_onnx("pretrained/warehouse", tmp_path / "warehouse.onnx")
    assert [*differences] == [(31, 24), (33, 20), (37, 25)] and max(differences.values()) <= 1e-5


@pytest.mark.parametrize(
    ("count", "rows"), [(0, [23]), (1, [23]), (2, [11, 23]), (24, [*range(24)]), (99, [*range(24)])]
)
def test_a_check_has_the_last_problem(count, rows):
    entries = onnx_model._some_problems([torch.arange(24), torch.arange(24) + 1], count)
    assert [entry.tolist() for entry in entries] == [rows, [row + 1 for row in rows]]
