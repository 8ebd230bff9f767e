"""A real server on loopback: its answers, its sessions, its keys, and what hostile clients achieve."""

import threading
from functools import partial

import msgpack
import numpy as np
import pytest
import torch
import zmq
from evaluation_cases import airbot, trajectory
from serving_cases import HOME, POSE, Busy, Slow, Waiting, serving

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.evaluation.rollouts import make_rollouts
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.serving.limits import Limits
from lerobot_mimicik.serving.server import IKServer
from lerobot_mimicik.solvers import make_solver
from lerobot_mimicik.solvers.remote_client import IKClient
from lerobot_mimicik.wire import protocol
from lerobot_mimicik.wire.protocol import (
    BadRequestError,
    RateExceededError,
    ServerTimeoutError,
    ServingError,
    SolverFailedError,
    UnknownSessionError,
)
from lerobot_mimicik.wire.security import ClientKeys, ServerKeys, make_keys

# s: a machine that is busy with other things answers late; a server that does not answer at all is found in the end.
PATIENT = 300.0
HOSTILE = 1000


@pytest.fixture(scope="module")
def address():
    """Where a server with default limits listens."""
    with serving() as server:
        yield server.address


def connect(address, solver="counting", **options):
    """A client that waits long enough for a busy machine."""
    return IKClient(address, solver, **({"timeout_s": PATIENT} | options))


def test_remote_answers_are_those_of_the_solver_here(address):
    one = trajectory(12)
    here = make_solver("hold", airbot())
    remote = make_solver("remote", airbot(), address=address, solver="hold", timeout_s=PATIENT)
    assert remote.batched
    with remote:
        for q, target in ((one.q, one.target), (one.q[0], one.target[0]), (one.q[:1], one.target[:1])):
            remote.reset(q)
            answer = remote.solve(q, target)
            np.testing.assert_array_equal(answer, here.solve(q, target))
            assert answer.flags.writeable
        np.testing.assert_array_equal(
            remote.solve_recorded(one.q, one.target), here.solve_recorded(one.q, one.target)
        )


def test_a_rollout_takes_a_remote_solver_for_any_other(address):
    recordings = [trajectory(7), trajectory(4, index=1)]
    with connect(address, "hold") as remote:
        there = make_rollouts("closed_loop", remote, recordings)
    here = make_rollouts("closed_loop", make_solver("hold", airbot()), recordings)
    for a, b in zip(there, here, strict=True):
        np.testing.assert_array_equal(a.q_cmd, b.q_cmd)


@pytest.mark.parametrize("name", ["guided", "guided_ahead"])
def test_looking_ahead_through_a_server_is_looking_ahead_here(name):
    one = trajectory(12)
    here, there = make_solver(name, airbot()), {name: partial(make_solver, name, airbot())}
    with serving(factories=there) as server, connect(server.address, name) as remote:
        assert remote.look_ahead == here.look_ahead
        for a, b in zip(*(make_rollouts("closed_loop", each, [one]) for each in (here, remote)), strict=True):
            np.testing.assert_array_equal(a.q_cmd, b.q_cmd)
        # Only what the solver looks at travels, and it holds for one question.
        for solver in (here, remote):
            solver.reset(one.q[0])
            solver.foresee(one.target[1 : 1 + solver.look_ahead])
        for t in range(2):
            np.testing.assert_array_equal(
                here.solve(one.q[t], one.target[t]), remote.solve(one.q[t], one.target[t])
            )


def test_a_future_that_is_none_is_refused_and_the_session_goes_on():
    with (
        serving(factories={"guided_ahead": partial(make_solver, "guided_ahead", airbot())}) as server,
        connect(server.address, "guided_ahead") as remote,
    ):
        remote.reset(HOME)
        question = [protocol.encode_array(HOME), protocol.encode_array(POSE)]
        for upcoming, message in (
            (np.tile(POSE, (8, 1)), "up to 7 targets"),
            (POSE, "up to 7 targets"),
            (np.full((2, 7), np.nan), "upcoming: holds numbers that are not finite"),
            (np.zeros((2, 7)), "upcoming: a quaternion"),
            (np.zeros((2, 3)), "upcoming: expected shape"),
        ):
            with pytest.raises(BadRequestError, match=message):
                remote._ask("solve", *question, protocol.encode_array(upcoming))
        with pytest.raises(BadRequestError, match="takes 2 or 3 arguments, got 4"):
            remote._ask("solve", *question, *question)
        assert np.isfinite(remote.solve(HOME, POSE)).all()


@pytest.fixture(scope="module")
def policy():
    """A small policy with random weights, that was trained on small steps."""
    config = MimicIKConfig(device="cpu", d_model=16, n_layers=1, n_heads=2, d_ff=16, conditioning="relative")
    policy = MimicIKPolicy(config)
    torch.manual_seed(0)
    for parameter in policy.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    policy.conditioning.relative.lower.fill_(-0.012)
    policy.conditioning.relative.upper.fill_(0.012)
    return policy


def test_a_policy_behind_the_server_answers_as_it_does_here(policy):
    one = trajectory(8)
    here = make_solver("mimicik", airbot(), policy=policy)
    there = {"mimicik": partial(make_solver, "mimicik", airbot(), policy=policy)}
    with serving(factories=there) as server, connect(server.address, "mimicik") as remote:
        for solver in (here, remote):
            solver.reset(one.q[:1])
        answers = [
            [solver.solve(one.q[t : t + 1], one.target[t : t + 1]) for t in range(len(one))]
            for solver in (here, remote)
        ]
        np.testing.assert_allclose(answers[1], answers[0], atol=1e-6)
        assert np.ptp(np.concatenate(answers[0]) - one.q) > 0
        np.testing.assert_allclose(
            remote.solve_recorded(one.q, one.target), np.concatenate(answers[0]), atol=1e-5
        )


def test_the_history_is_each_clients_own_and_reset_forgets_it(address):
    with connect(address) as a, connect(address) as b, connect(address, "single") as c:
        a.reset(HOME)
        b.reset(HOME)
        for step in (1, 2, 3):
            np.testing.assert_allclose(a.solve(HOME, POSE), HOME + step)
        np.testing.assert_allclose(b.solve(HOME, POSE), HOME + 1)
        a.reset(HOME)
        np.testing.assert_allclose(a.solve(HOME, POSE), HOME + 1)
        np.testing.assert_allclose(c.solve(HOME, POSE), HOME + 1)  # without a reset: as a new solver
        assert not c.batched


def test_rows_that_are_selected_keep_their_history(address):
    q, pose = np.tile(HOME, (3, 1)), np.tile(POSE, (3, 1))
    with connect(address) as client:
        client.reset(q)
        client.solve(q, pose)
        client.select(np.array([2, 0]))
        np.testing.assert_allclose(client.solve(q[:2], pose[:2]), q[:2] + 2)
        client.select(np.array([], dtype=np.intp))


@pytest.mark.parametrize(
    ("q", "target", "message"),
    [
        (HOME[:5], POSE, r"q: expected shape \(6,\) or \(rows, 6\)"),
        (HOME, POSE[:6], r"target: expected shape \(7,\)"),
        (HOME[None, None], POSE, "two axes"),
        (np.tile(HOME, (2, 1)), POSE, "as many rows"),
        (np.full(6, np.nan), POSE, "not finite"),
        (HOME, np.full(7, -np.inf), "not finite"),
        (HOME, np.zeros(7), "quaternion"),
        (HOME, np.array([0.3, 0, 0.3, 0, 0, 0, 5e-324]), "quaternion"),
        (np.zeros((0, 6)), np.zeros((0, 7)), "1 to 4096 rows"),
        (np.zeros((4097, 6)), np.ones((4097, 7)), "1 to 4096 rows"),
    ],
)
def test_bad_questions_are_refused_and_the_session_goes_on(address, q, target, message):
    with connect(address) as client:
        client.reset(HOME)
        with pytest.raises(BadRequestError, match=message):
            client.solve(q, target)
        np.testing.assert_allclose(client.solve(HOME, POSE), HOME + 1)


def test_what_only_one_side_can_know_is_refused_by_that_side(address):
    with pytest.raises(ValueError, match="no solver 'magic'; it has hold"):
        connect(address, "magic")
    with pytest.raises(ValueError, match="solves for joints"):
        connect(address, joint_names=("elbow",))
    with pytest.raises(ValueError, match="timeout_s"):
        connect(address, timeout_s=0.0)
    with pytest.raises(ValueError, match="belong together"):
        make_solver("remote", airbot(), address=address, secret_key="x")
    with connect(address) as client:
        client.reset(HOME)
        with pytest.raises(ValueError, match="fewer rows"):
            client.solve(np.zeros((20_000, 6)), np.zeros((20_000, 7)))
        with pytest.raises(BadRequestError, match="row numbers"):
            client.select(np.array([-1]))
    with connect(address, "single") as client, pytest.raises(BadRequestError, match="one configuration"):
        client.reset(np.tile(HOME, (2, 1)))


def test_a_solver_that_fails_is_its_clients_trouble_only(address):
    with connect(address, "failing") as client, connect(address) as other:
        client.reset(HOME)
        with pytest.raises(SolverFailedError, match="ZeroDivisionError: no way there"):
            client.solve(HOME, POSE)
        np.testing.assert_allclose(other.solve(HOME, POSE), HOME + 1)


def test_a_long_question_does_not_hold_up_a_short_one(address):
    """The short one is answered first although it is asked last, behind several long ones."""
    Busy.somebody.clear()
    q, target = np.tile(HOME, (1000, 1)), np.tile(POSE, (1000, 1))
    with connect(address, "noticing") as modest, zmq.Context.instance().socket(zmq.DEALER) as greedy:
        greedy.linger, greedy.rcvtimeo = 0, 20_000
        greedy.connect(address)
        greedy.send(protocol.pack_request(1, "reset", b"", ["busy", protocol.encode_array(HOME)]))
        _, session = protocol.unpack_reply(greedy.recv())
        for number in range(2, 7):
            recording = [protocol.encode_array(q), protocol.encode_array(target)]
            greedy.send(protocol.pack_request(number, "solve_recorded", session, recording))
        np.testing.assert_allclose(modest.solve(HOME, POSE), HOME + 1)
        assert not greedy.poll(0)
        for number in range(2, 7):
            found, value = protocol.unpack_reply(greedy.recv())
            assert found == number
            answer = protocol.decode_array(value, "answer")
            np.testing.assert_allclose(answer, q + np.arange(1, 1001)[:, None])


def test_a_slow_solvers_batch_is_answered_in_pieces_that_take_a_few_milliseconds(address):
    Slow.pieces.clear()
    q, target = np.tile(HOME, (60, 1)), np.tile(POSE, (60, 1))
    with connect(address, "slow") as client:
        client.reset(q)
        np.testing.assert_array_equal(client.solve(q, target), q)
    assert sum(Slow.pieces) == 60
    assert max(Slow.pieces[1:]) <= 10  # 20 ms


def test_who_sends_without_waiting_is_refused_and_others_are_served():
    Waiting.gate.clear()
    try:
        with (
            serving(limits=Limits(max_waiting=3)) as server,
            zmq.Context.instance().socket(zmq.DEALER) as greedy,
        ):
            greedy.linger, greedy.rcvtimeo = 0, 20_000
            greedy.connect(server.address)
            greedy.send(protocol.pack_request(1, "reset", b"", ["waiting", protocol.encode_array(HOME)]))
            _, session = protocol.unpack_reply(greedy.recv())
            question = [protocol.encode_array(HOME), protocol.encode_array(POSE)]
            for number in range(2, 22):
                greedy.send(protocol.pack_request(number, "solve", session, question))
            Waiting.gate.set()
            replies = [protocol.unpack_reply(greedy.recv())[1] for _ in range(20)]
            refused = [reply for reply in replies if isinstance(reply, RateExceededError)]
            assert len(refused) <= 17
            assert all("3 requests are waiting" in str(reply) for reply in refused)
            with connect(server.address) as other:
                np.testing.assert_allclose(other.solve(HOME, POSE), HOME + 1)
    finally:
        Waiting.gate.set()


def test_an_answer_that_is_not_finite_is_an_error(address):
    with connect(address, "undefined") as client:
        for rows in ((), (3,)):
            q, pose = np.broadcast_to(HOME, (*rows, 6)), np.broadcast_to(POSE, (*rows, 7))
            client.reset(q)
            with pytest.raises(SolverFailedError, match="not finite"):
                client.solve(q, pose)


def test_what_a_server_answers_in_pieces_is_what_is_answered_at_once(policy):
    q = HOME + 0.01 * np.arange(300)[:, None] * np.ones(6)
    target = np.tile(POSE, (300, 1))
    here = make_solver("mimicik", airbot(), policy=policy)
    there = {"mimicik": partial(make_solver, "mimicik", airbot(), policy=policy)}
    with serving(factories=there) as server, connect(server.address, "mimicik") as remote:
        for solver in (here, remote):
            solver.reset(q)
        for _ in range(2):
            np.testing.assert_allclose(remote.solve(q, target), here.solve(q, target), atol=1e-6)
        np.testing.assert_allclose(
            remote.solve_recorded(q, target), here.solve_recorded(q, target), atol=1e-6
        )


def test_the_session_idle_for_longest_is_dropped_and_reset_opens_another():
    with serving(limits=Limits(max_sessions=2)) as server:
        a, b, c = (connect(server.address) for _ in range(3))
        a.reset(HOME)
        b.reset(HOME)
        a.solve(HOME, POSE)
        c.reset(HOME)
        np.testing.assert_allclose(a.solve(HOME, POSE), HOME + 2)
        for _ in range(2):
            with pytest.raises(UnknownSessionError, match=r"more than 2 were wanted. reset\(q\)"):
                b.solve(HOME, POSE)
        b.reset(HOME)
        np.testing.assert_allclose(b.solve(HOME, POSE), HOME + 1)
        for client in (a, b, c):
            client.close()
            client.close()
        with pytest.raises(ServingError, match="closed"):
            a.solve(HOME, POSE)


def test_a_client_that_asks_too_often_is_told_so_and_others_are_not():
    with (
        serving(limits=Limits(rate=1e-3, burst=5)) as server,
        connect(server.address) as greedy,
        connect(server.address) as modest,
    ):
        greedy.reset(HOME)
        for _ in range(3):
            greedy.solve(HOME, POSE)
        with pytest.raises(RateExceededError, match=r"0\.001 requests a second"):
            greedy.solve(HOME, POSE)
        modest.reset(HOME)
        np.testing.assert_allclose(modest.solve(HOME, POSE), HOME + 1)


def test_nobody_there_is_a_timeout_that_says_where_and_what_to_do():
    with zmq.Context.instance().socket(zmq.ROUTER) as socket:
        port = socket.bind_to_random_port("tcp://127.0.0.1")
    with pytest.raises(TimeoutError, match=rf"tcp://127\.0\.0\.1:{port}.*mimicik serve.*timeout_s"):
        IKClient(f"tcp://127.0.0.1:{port}", "hold", timeout_s=0.1)


def test_after_a_timeout_the_late_answer_is_not_taken_for_the_next():
    Waiting.gate.clear()
    try:
        with serving() as server, connect(server.address, "waiting") as client:
            client.reset(HOME)
            client.timeout_s = 0.1
            with pytest.raises(ServerTimeoutError, match=r"within 0\.1 s"):
                client.solve(HOME, POSE)
            Waiting.gate.set()
            client.timeout_s = PATIENT
            np.testing.assert_allclose(client.solve(HOME - 1, POSE), HOME - 1 + 2)
    finally:
        Waiting.gate.set()


def test_a_reply_to_another_request_is_not_taken_for_an_answer():
    """A server that first sends answers with other ids, then the right one."""

    def answer(router):
        for _ in range(2):
            sender, request = router.recv_multipart()
            number = int.from_bytes(request[:8])
            info = {"joint_names": ["a"], "solvers": {"s": False}, "max_bytes": 999, "max_rows": 9}
            value = info if protocol.unpack_request(request)[0] == "info" else b"right"
            for other in (number - 1, number + 1):
                router.send_multipart([sender, protocol.pack_reply(other.to_bytes(8), b"wrong")])
            router.send_multipart([sender, protocol.pack_reply(number.to_bytes(8), value)])

    with zmq.Context.instance().socket(zmq.ROUTER) as router:
        router.rcvtimeo, router.linger = 300_000, 0
        port = router.bind_to_random_port("tcp://127.0.0.1")
        thread = threading.Thread(target=answer, args=(router,))
        thread.start()
        client = connect(f"tcp://127.0.0.1:{port}", "s")
        client.reset(np.zeros(1))
        thread.join(PATIENT)
        assert client.session == b"right"
        client.close()


def test_closing_twice_is_closing_once_and_frees_the_address():
    server = IKServer({"hold": lambda: make_solver("hold", airbot())}, ["a"], "tcp://127.0.0.1:0")
    with pytest.raises(OSError, match="Cannot listen on"):
        IKServer({"hold": lambda: make_solver("hold", airbot())}, ["a"], server.address)
    server.stop()
    server.serve()
    server.close()
    server.close()
    with IKServer({"hold": lambda: make_solver("hold", airbot())}, ["a"], server.address) as again:
        assert again.address == server.address


def test_over_ipc_as_over_tcp(tmp_path):
    with serving(bind=f"ipc://{tmp_path}/ik") as server, connect(server.address) as client:
        np.testing.assert_allclose(client.solve(HOME, POSE), HOME + 1)


@pytest.mark.parametrize("bind", ["tcp://*:0", "tcp://0.0.0.0:0", "tcp://[::]:0", "tcp://192.0.2.1:0"])
def test_without_keys_nothing_but_loopback_is_served(bind):
    with pytest.raises(ValueError, match=r"must have keys.*127\.0\.0\.1"):
        IKServer({"hold": lambda: make_solver("hold", airbot())}, ["a"], bind)


def test_keys_let_in_whom_they_should_and_nobody_else(tmp_path):
    paths = {name: make_keys(tmp_path / name, name) for name in ("server", "robot", "stranger")}
    for _, secret in paths.values():
        assert secret.stat().st_mode & 0o077 == 0
    with pytest.raises(FileExistsError, match=r"robot\.key exists"):
        make_keys(tmp_path / "robot", "robot")
    allowed = tmp_path / "allowed"
    allowed.mkdir()
    server_keys = ServerKeys(str(paths["server"][1]), str(allowed))
    with pytest.raises(FileNotFoundError, match="nobody could connect"), serving(keys=server_keys):
        pass
    (allowed / "robot.key").write_bytes(paths["robot"][0].read_bytes())

    def keys(own, server="server"):
        return ClientKeys(str(paths[own][1]), str(paths[server][0]))

    with pytest.raises(ValueError, match="holds no secret key"):
        serving(keys=ServerKeys(str(paths["server"][0]), str(allowed))).__enter__()
    with serving(keys=server_keys, bind="tcp://0.0.0.0:0", limits=Limits(rate=1e-3, burst=8)) as server:
        address = server.address.replace("0.0.0.0", "127.0.0.1")
        with connect(address, keys=keys("robot")) as client:
            np.testing.assert_allclose(client.solve(HOME, POSE), HOME + 1)
        for wrong in (keys("stranger"), keys("robot", server="stranger"), None):
            with pytest.raises(ServerTimeoutError, match="key"):
                connect(address, keys=wrong, timeout_s=1.0)
        # The rate counts by key: another connection of the same client has no new allowance.
        with connect(address, keys=keys("robot")) as client:
            client.reset(HOME)
            while server.answered < 8:
                client.solve(HOME, POSE)
            with pytest.raises(RateExceededError):
                client.solve(HOME, POSE)


def hostile(rng: np.random.Generator, number: int, token: bytes) -> list[bytes]:
    """Frames of one message that no honest client sends; the kinds take turns."""
    q, pose = protocol.encode_array(HOME), protocol.encode_array(POSE)
    noise = rng.bytes(int(rng.integers(0, 400)))
    good = protocol.pack_request(number, "solve", token, [q, pose])
    head = number.to_bytes(8)
    nan = protocol.encode_array(np.where(rng.random(6) < 0.5, np.nan, np.inf))
    big = protocol.encode_array(np.zeros((5000, 6)))

    def ask(method, session, *arguments):
        return [protocol.pack_request(number, method, session, arguments)]

    kinds = [
        lambda: [noise],
        lambda: [head + noise],
        lambda: [good[: int(rng.integers(0, len(good)))]],
        lambda: [head + b"\xdd\xff\xff\xff\xff" + noise],  # an array of 2**32 - 1 values
        lambda: [head + b"\x95\x01\xc6\xff\xff\xff\xf0" + noise],  # 4 GB of bytes
        lambda: [head + b"\xdf\xff\xff\xff\xff"],  # a map of as many entries
        lambda: [head + b"\x91" * int(rng.integers(1, 5000))],  # lists in lists
        lambda: [head + msgpack.packb({"method": "solve"})],
        lambda: [head + msgpack.packb([1, ["solve"], token])],
        lambda: [head + msgpack.packb([2, "solve", token, q, pose])],
        lambda: [head + msgpack.packb([1, "solve", "text", q, pose])],
        lambda: [head + msgpack.packb([1, "solve", token, msgpack.ExtType(5, b"x"), pose])],
        lambda: ask("solve", token, nan, pose),
        lambda: ask("solve", token, big, big),
        lambda: ask("solve", token, ["<f8", [1 << 40, 6], b""], pose),
        lambda: ask("solve", token, ["O", [6], bytes(48)], pose),
        lambda: ask("solve", token, "q", {} if number % 2 else None),
        lambda: ask("solve", rng.bytes(16), q, pose),
        lambda: ask("solve", rng.bytes(60), q, pose),
        lambda: ask("solve", token, q, pose, pose),
        lambda: ask("__init__", token, q, pose),
        lambda: ask("reset", b"", "mimicik", q),
        lambda: ask("reset", b"", 7, q),
        lambda: ask("select", token, protocol.encode_array(np.array([9, 9]), protocol.INDEX)),
        lambda: [good, good],
        lambda: [b""] * int(rng.integers(1, 5)),
        lambda: [bytes((1 << 20) + 1 + number)],  # longer than a request may be
        lambda: [good[:8] + bytes(rng.permutation(np.frombuffer(good[8:], np.uint8)))],
    ]
    return kinds[number % len(kinds)]()


def test_a_thousand_hostile_messages_are_refused_one_by_one(address):
    rng = np.random.default_rng(0)
    with connect(address) as honest, zmq.Context.instance().socket(zmq.DEALER) as attacker:
        honest.reset(HOME)
        attacker.linger, attacker.rcvtimeo = 0, 300_000
        attacker.connect(address)
        refusals = set()
        for number in range(HOSTILE):
            frames = hostile(rng, number, honest.session)
            attacker.send_multipart(frames)
            reply = attacker.recv()
            assert reply[:8] == frames[-1][:8].ljust(8, b"\0")
            _, error = protocol.unpack_reply(reply)
            assert isinstance(error, ServingError), frames[-1][:100]
            refusals.add(error.code)
            if number % 100 == 0:
                np.testing.assert_allclose(honest.solve(HOME, POSE), HOME + 1 + number // 100)
        assert refusals == {"request", "session", "solver"}
        # Beyond twice the limit there is no reply: the connection goes, and the server stays.
        attacker.send(bytes(3 << 20))
        np.testing.assert_allclose(honest.solve(HOME, POSE), HOME + 11)


def test_strangers_of_other_protocols_and_flooders_who_never_read_do_no_harm(address):
    import socket

    rng = np.random.default_rng(1)
    host, port = address.removeprefix("tcp://").split(":")
    with connect(address) as honest, zmq.Context.instance().socket(zmq.DEALER) as flooder:
        for _ in range(20):
            with socket.create_connection((host, int(port))) as raw:
                raw.sendall(rng.bytes(200))
        flooder.linger = 0
        flooder.connect(address)
        for number in range(2000):
            flooder.send(protocol.pack_request(number, "info", b""))
        np.testing.assert_allclose(honest.solve(HOME, POSE), HOME + 1)
