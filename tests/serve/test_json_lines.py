"""``pickplace-plan``: one plan from files, and a process that answers JSON lines."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from pickplace import CellSpec, Planner, Scene
from pickplace.rules.gripper.rules import Overlap
from pickplace.rules.support.rules import Full, Half
from pickplace.runs import checkpoint
from pickplace.runs.locate import locate
from pickplace.serve import json_lines
from pickplace.serve.deadline import Deadline
from pickplace.serve.decisions import DecisionLog, service_facts
from pickplace.serve.options import load_planner
from pickplace.serve.request import RequestLimits, answer, read_request, solve

EMPTY = np.full((6, 6), 5)
ITEM = np.zeros((5, 5), dtype=np.int64)
ITEM[1:3, 2] = 1


@pytest.fixture
def command(run):
    return partial(run, "plan", lines=b"")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere"),
        (["pretrained/none"], "expected pretrained/cdrl_rs, pretrained/cut1, pretrained/cut2, pretrained/gopt_buffer"),
        (["pretrained/r4", "--bin", "bin.npy"], "--tote: no file"),
        (["pretrained/r4", "--bin", "bin.npy", "--tote", "missing.npy"], "missing.npy: No such file"),
        (["pretrained/r4", "--bin", "bin.npy", "--tote", "pickle.npy"], "pickle.npy: cannot be read; expected a .npy"),
        (["pretrained/r4", "--bin", "bin.npy", "--tote", "/proc/kmsg"], "/proc/kmsg: 0 bytes; expected"),
        (["pretrained/r4", "--candidates", "some"], "candidates='some'"),
        (["pretrained/r4", "--threads", "0"], "--threads=0"),
        (["pretrained/r4", "--rotations", "7"], "rotations=7"),
        (["pretrained/r4", "--device", "tpu"], "tpu"),
        ([], "checkpoint: missing; expected a checkpoint, or --planner"),
        (["pretrained/r4", "more"], "unrecognized arguments: more"),
        (["--planner", "joint_dbl", "--candidates", "5"], "--candidates=5: only a policy has candidates"),
        (["--planner", "lookahead"], "planner='lookahead' needs it; Planner.load has it from a checkpoint"),
    ],
)
def test_command_refuses_in_one_sentence(command, tmp_path, arguments, message):
    np.save(tmp_path / "bin.npy", ITEM)
    np.save(tmp_path / "pickle.npy", np.array([{}]), allow_pickle=True)
    code, out, err = command(*arguments)
    assert code == 2 and out == ""
    assert err.startswith("error: ") and err.count("\n") == 1 and message in err and "allow_pickle" not in err


def test_command_answers_json_lines_and_survives_bad_ones(command):
    good = {"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist(), "alternatives": 0}
    lines = [
        (b'{"id": ' + b"[" * 200 + b"]" * 200 + b"}", "id: it holds 200 lists and objects, expected at most 100"),
        (b"not json", "not JSON"), (b"\xff\xfe", "utf-8"), (b"[" * 2_000, "recursion"), (b"[1, 2]", "got list"),
        (b"9" * 10_000, "got 99999999999999999999..., expected at most 300 digits"),
        (b"[" * 100_000, "100,000 lists, rows of maps included"),
        (b'{"id": 1, "tote_depth": [[5]], "id": 1}', "'id' stands twice in an object"),
        (b'{"items": [{"x": 1, "x": 1}]}', "'x' stands twice"),
    ]  # fmt: skip
    requests = [
        ({"id": "a", **good}, None), ({"id": 7, "tote_depth": good["tote_depth"]}, "bin_depth: missing"),
        ({"id": 8, **good, "tote": 1}, "there is no such key"),
        ({"id": 8, **good, "items": []}, "bin_depth, items: got both, expected one of the two"),
        ({"id": 8, "tote_depth": good["tote_depth"], "items": [], "bin_labels": []}, "bin_labels, items: got both"),
        ({"id": 8, **good, "items": None, "cell_size": None}, None),
        ({"id": 9, **good, "bin_depth": [[0.0] * 5] * 5}, "one item"),
        ({**good, "tote_height": float("nan")}, "NaN"), ({**good, "alternatives": 10**9}, "<= 100,000"),
        ({"id": 11, **good, "tote_depth": [[0] * 6] * 6}, None),
        ({"id": {"b": 1}, **good}, None),
    ]  # fmt: skip
    lines += [(json.dumps(request).encode(), error) for request, error in requests]
    code, out, err = command("pretrained/r4", lines=b"\n\n".join(line for line, _ in lines))  # empty lines, too
    replies = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and err == ""
    assert "sys." not in out
    for reply, (_, expected) in zip(replies, lines, strict=True):
        assert ("error" in reply) == (expected is not None) and (expected or "") in reply.get("error", ""), reply
    assert [reply.get("id") for reply in replies] == [None] * 9 + [request.get("id") for request, _ in requests]
    assert [reply["id"] for reply in replies if reply.get("empty_bin")] == [9]
    first, *_, stuck, last = replies[9:]
    assert stuck["status"] == "stuck" and sum(stuck["reasons"].values()) == 3600
    assert {**first, "id": 0} == {**last, "id": 0} and first["status"] == "ok"


def test_command_hands_every_option_on(command, tmp_path):
    item = np.zeros((5, 4))
    item[1:3, 2] = 0.9
    np.save(tmp_path / "bin.npy", item * 0.05)
    np.save(tmp_path / "tote.npy", np.full((7, 6), 0.2))
    arguments = ["pretrained/r4", "--bin", "bin.npy", "--tote", "tote.npy", "--cell-size", 0.05, "--candidates", 10]
    arguments += ["--bin-size", 5, 4, 1, "--tote-size", 7, 6, 9, "--effector-size", 2, 2, "--rotations", 1]
    arguments += ["--tote-height", 0.2, "--alternatives", 1, "--threads", 1, "--time"]
    code, out, err = command(*arguments)
    assert code == 0 and err.startswith("planned in ") and err.endswith(" ms\n")
    plan = json.loads(out)
    assert plan["status"] == "ok" and plan["rotation_degrees"] == 0 and len(plan["alternatives"]) in (1, 2)
    assert plan["occupancy_after"] == pytest.approx(0.9 * 2 / (7 * 6 * 4))
    assert plan["pick"]["center"][:2] == pytest.approx([0.1, 0.125], abs=0.025)  # two cells of an effector cover both
    assert plan["place"]["center"][2] == pytest.approx(0.045 + 2 * 0.003)  # released twice the accuracy above its top
    exact = json.loads(command(*arguments, "--accuracy", 0, "--clearance", 0.001)[1])
    assert exact["place"]["center"][2] == pytest.approx(0.045)
    assert "accuracy=0.5" in command(*arguments, "--accuracy", 0.5)[2]
    searching = json.loads(command(*arguments, "--planner", "joint_dbl")[1])
    assert searching["status"] == "ok" and searching["alternatives"] == [] and searching["place"]["cell"] == [0, 0]


def test_the_reach_of_a_file(command, tmp_path):
    """The nearest places are out of reach; without limits the plan is another one; a bad file is named."""
    (tmp_path / "mine.yaml").write_text(
        "# @package env\nreach: {_target_: annulus, radii: [6, 12], heights: [0, 9], bin: [-12, 0, 0], tote: [0, 0, 0]}"
    )
    (tmp_path / "all.yaml").write_text("reach: null\n")
    request = json.dumps({"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist()}).encode()
    near, far = (
        [
            json.loads(command(*given, "--alternatives", 0, "--reach", name, lines=request)[1])["place"]["center"]
            for given in (["pretrained/r4"], ["--planner", "joint_dbl"])
        ]
        for name in ("all.yaml", "mine.yaml")
    )
    assert all(np.hypot(x, y) < 6 for x, y, _ in near) and all(6 <= np.hypot(x, y) <= 12 for x, y, _ in far)
    for text, expected in (
        ("reach: {", "--reach=bad.yaml: while parsing"),
        ("radii: [1, 2]", "--reach=bad.yaml: expected annulus, everywhere, table, or a file with the key reach"),
        (
            "reach: {_target_: anulus}",
            "env.reach._target_=anulus: there is no such class or function; did you mean 'annulus'",
        ),
        ("reach: far", "reach='far': expected a Reach"),
    ):
        (tmp_path / "bad.yaml").write_text(text)
        code, out, err = command("--planner", "joint_dbl", "--reach", "bad.yaml", lines=request)
        assert code == 2 and out == "" and err.startswith(f"error: {expected}") and err.count("\n") == 1, err
    assert "nowhere.yaml" in command("--planner", "joint_dbl", "--reach", "nowhere.yaml")[2]


def test_a_request_has_the_last_word(command):
    """Over what the command line says for all."""
    plain = {"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist()}
    metric = {"items": [{"x": 0.1, "y": 0.125, "w": 0.09, "d": 0.04, "h": 0.05}], "cell_size": 0.05}
    metric["tote_depth"] = (EMPTY * 0.05).tolist()
    low = {"bin_depth": ITEM.tolist(), "tote_depth": (EMPTY - 3).tolist(), "tote_height": 2, "alternatives": 2}
    lines = "\n".join(json.dumps(request) for request in (plain, metric, low)).encode()
    code, out, err = command("pretrained/r4", "--accuracy", 0, "--alternatives", 0, lines=lines)
    replies = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and [reply.get("status") for reply in replies] == ["ok"] * 3, err
    assert replies[1]["pick"]["center"] == pytest.approx([0.05 * length for length in replies[0]["pick"]["center"]])
    assert replies[2]["occupancy_after"] == pytest.approx(2 / 72)
    assert [bool(reply["alternatives"]) for reply in replies] == [False, False, True]


def test_the_parts_of_the_cell_are_options(command, tmp_path):
    """By their names in ``conf/``, or from files; the plans are those of a planner that was made with them."""
    (tmp_path / "mine.yaml").write_text("gripper: {_target_: overlap, size: [1, 1]}")
    request = {"bin_depth": ITEM.tolist(), "tote_depth": (EMPTY - [[1], [0], [1], [0], [1], [0]]).tolist()}
    line = json.dumps({**request, "alternatives": 0}).encode()
    for arguments, parts in (
        (["--gripper", "point"], {"gripper": Overlap((1, 1))}),
        (["--gripper", "mine.yaml", "--support", "half"], {"gripper": Overlap((1, 1)), "support": Half()}),
        (["--support", "full"], {"support": Full()}),
    ):
        code, out, err = command("--planner", "joint_dbl", *arguments, lines=line)
        assert code == 0, err
        expected = Planner(CellSpec(**parts), planner="joint_dbl").plan(Scene.from_maps(**request), alternatives=0)
        assert json.loads(out) == json.loads(json.dumps(expected.as_dict()))
    assert "expected bearing, cdrl, corners, full" in command("--planner", "joint_dbl", "--support", "none.yaml")[2]


def test_a_file_holds_the_settings_of_a_planner(command):
    labels = np.zeros((5, 5), dtype=int)
    labels[4, 4], labels[0, 0] = 1, 2
    bin_depth = (labels > 0).astype(int)
    lists = {"bin_depth": bin_depth.tolist(), "bin_labels": labels.tolist(), "tote_depth": EMPTY.tolist()}
    taken = []
    for rule in ("any", "nearest"):
        Path("mine.yaml").write_text(f"{{_target_: joint_dbl, item: {rule}}}")
        code, out, err = command("--planner", "mine.yaml", lines=json.dumps({**lists, "alternatives": 0}).encode())
        assert code == 0, err
        taken.append(json.loads(out)["item_number"])
    assert taken == [0, 1]  # equal items: the first, and the one at the origin
    line = json.dumps(lists).encode()
    for content, message in (
        ("{item: any}", "--planner=mine.yaml: expected settings with the key _target_, such as conf/planner/"),
        ("{_target_: joint_dbl, item: {_target_: os.system, command: ls}}", "planner.item._target_='os.system'"),
        ("[", "--planner=mine.yaml: while parsing a flow node"),
        (
            "{_target_: joint_dbl, distance_weight: 1}",
            "planner.distance_weight: there is no key 'distance_weight'",
        ),
    ):
        Path("mine.yaml").write_text(content)
        code, _, err = command("--planner", "mine.yaml", lines=line)
        assert code == 2 and message in err, err


@pytest.mark.parametrize(("name", "change"), [("paper", "bias"), ("cut1", "scale")])
def test_weights_that_lead_to_no_number_are_refused(command, tmp_path, name, change):
    """They are finite, and so is the setting, and the checksum is right: what comes of them is not."""
    state, facts = checkpoint.read(locate(f"pretrained/{name}"))
    if change == "bias":
        state["policy"]["network.first.bias"] = torch.full_like(state["policy"]["network.first.bias"], 3e38)
        words = "the policy's scores are not finite"
    else:
        facts["config"]["model"]["actor"]["reward_scale"] = 1e308
        words = "model.actor.reward_scale=1e+308: expected a number between 1e-09 and 1e+38"
    checkpoint.write(tmp_path / "bad", state, {key: facts[key] for key in facts if key not in ("schema", "sha256")})
    line = json.dumps({"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist()}).encode()
    code, out, err = command(tmp_path / "bad", "--tote-size", 6, 6, 5, "--bin-size", 5, 5, 1, lines=line)
    assert (code, out) == (2, "") and words in err and err.count("\n") == 1
    if change == "bias":
        planner = Planner.load(tmp_path / "bad")
        with pytest.raises(FloatingPointError, match=words):
            planner.plan(Scene.from_maps(ITEM, EMPTY))


def test_a_plan_with_a_number_that_json_lacks_is_no_answer(monkeypatch):
    planner = Planner(CellSpec(), planner="joint_dbl")
    plan = replace(planner.plan(Scene.from_maps(ITEM, EMPTY)), occupancy_after=float("nan"))
    monkeypatch.setattr(planner, "plan", lambda *_, **__: plan)
    line = json.dumps({"id": 1, "bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist()}).encode()
    found = answer(planner, line, {})
    sentence = "the plan has a number that is not finite; expected another checkpoint."
    assert (found.status, json.loads(found.text)) == (500, {"id": 1, "error": sentence})


def test_a_deadline_ends_the_answer_to_a_line_and_not_the_next(command):
    lines = [{"deadline": 0.02}, {"deadline": 600}]  # the machine may be busy
    texts = (json.dumps({"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist(), **line}) for line in lines)
    code, out, err = command("pretrained/r4", "--planner", "lookahead", lines="\n".join(texts).encode())
    late, plan = map(json.loads, out.splitlines())
    assert code == 0 and "no plan within 0.02 s" in late["error"] and plan["status"] == "ok"


def test_the_limit_of_a_request_follows_from_the_cell():
    """64 values along a cell of each map fit, at 8 bytes each; and never more than 16 MiB."""
    cell = CellSpec()
    rows = [[0.25] * (64 * 6)] * (64 * 6)
    maps = {"bin_depth": [[0.0] * 320] * 320, "bin_labels": [[0] * 320] * 320, "tote_depth": rows}
    text = json.dumps(maps).encode()
    RequestLimits.of(cell).check(text)
    with pytest.raises(ValueError, match="more than 2,883,872 bytes"):
        RequestLimits.of(cell).check(text + b" " * 2_000_000)
    assert RequestLimits.of(CellSpec(tote_size=(40, 40, 5))).size == 2**24


def test_a_log_is_replayed(command, tmp_path, monkeypatch):
    """The plans are the same; one that was changed is named, and so are other weights."""
    log = tmp_path / "log.jsonl"
    args = json_lines.parser().parse_args(["pretrained/r4", "--tote-size", "6", "6", "5", "--support", "hull"])
    planner, defaults = load_planner(args)
    decisions = DecisionLog(log, service_facts(planner, args))
    metres = {"items": [{"x": 0.1, "y": 0.125, "w": 0.09, "d": 0.04, "h": 0.05}], "cell_size": 0.05, "id": "b"}
    given = [
        {"bin_depth": ITEM.tolist(), "tote_depth": EMPTY.tolist(), "id": 1},
        {**metres, "tote_depth": (EMPTY * 0.05).tolist()},
        {"bin_depth": ITEM.tolist(), "tote_depth": [[5]]},
        {"bin_depth": ITEM.tolist(), "tote_depth": (EMPTY * 0).tolist()},
    ]
    for one in given:
        _, reply, request = read_request(json.dumps(one).encode(), RequestLimits.of(planner.cell), defaults)
        decisions.add(request, solve(planner, request, reply, Deadline(60)).reply, 0.1)
    decisions.add(None, {"error": "the request is not JSON"}, 0.0)
    lines = log.read_text().splitlines()
    assert len(lines) == 6 and json.loads(lines[0])["start"]["checkpoint"] == "pretrained/r4"
    assert command("--replay", log) == (0, "3 of 3 plans are the same\n", "")
    DecisionLog(log, service_facts(planner, args))  # the service was started again
    assert log.read_text().splitlines()[:6] == lines and command("--replay", log)[0] == 0
    whole = log.read_bytes()
    log.write_bytes(whole[: len("\n".join(lines[:3])) - 40])  # the power fails while a line is written
    DecisionLog(log, service_facts(planner, args)).add(request, json.loads(lines[3])["reply"], 0.1)
    code, out, err = command("--replay", log)
    assert code == 1 and "line 3: expected an object in JSON" in out and out.endswith("1 of 2 plans are the same\n")
    log.write_bytes(whole)
    changed = json.loads(lines[1])
    changed["reply"]["action"] += 1
    log.write_text("\n".join([lines[0], json.dumps(changed), *lines[2:]]))
    code, out, err = command("--replay", log)
    assert code == 1 and out.endswith("2 of 3 plans are the same\n") and "log.jsonl, line 2: action is" in out
    start = json.loads(lines[0])
    start["start"]["sha256"] = "0"
    for text, words in (
        (json.dumps(start), "line 1: checkpoint=pretrained/r4: other weights than those of the log"),
        (lines[1], "line 1: expected a line with the key start before it"),
        ("[1]", "line 1: expected an object in JSON (got list)"),
    ):
        log.write_text(text)
        code, out, err = command("--replay", log)
        assert (code, out) == (2, "") and words in err and err.count("\n") == 1
    assert "expected no other" in command("pretrained/r4", "--replay", log)[2]
