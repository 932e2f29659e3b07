import numpy as np
import pytest

from covis.fusion.channel import HEADER_BYTES, Channel, ChannelOptions, message_size
from covis.matching.graph import ObjectGraph


def test_a_message_arrives_after_the_latency_and_once():
    channel = Channel(np.random.default_rng(0), ChannelOptions(latency_s=0.4))
    channel.send("a", "b", "hello", time=1.0, size_bytes=100)
    assert list(channel.receive(time=1.3)) == []
    (message,) = channel.receive(time=1.5)
    assert (message.payload, message.sent_s, message.sender, message.receiver) == ("hello", 1.0, "a", "b")
    assert message.received_s == pytest.approx(1.4)
    assert list(channel.receive(time=9.0)) == []
    assert channel.traffic.sent_bytes == channel.traffic.delivered_bytes == 100


def test_loss_is_as_asked_for_and_counted():
    channel = Channel(np.random.default_rng(1), ChannelOptions(loss=0.3))
    for k in range(2000):
        channel.send("a", "b", k, time=float(k), size_bytes=10)
    got = list(channel.receive(time=1e9))
    assert len(got) == 2000 - channel.traffic.lost == channel.traffic.delivered
    assert channel.traffic.lost / 2000 == pytest.approx(0.3, abs=0.04)
    assert channel.traffic.sent_bytes == 20000
    assert channel.traffic.delivered_bytes == 10 * len(got)


def test_bandwidth_makes_messages_queue():
    channel = Channel(np.random.default_rng(2), ChannelOptions(bandwidth_bytes_s=1000.0, latency_s=0.1))
    for _ in range(3):
        channel.send("a", "b", None, time=0.0, size_bytes=500)
    np.testing.assert_allclose([m.received_s for m in channel.receive(time=10)], [0.6, 1.1, 1.6])


def test_jitter_lets_messages_overtake_but_never_arrive_before_they_were_sent():
    channel = Channel(np.random.default_rng(3), ChannelOptions(latency_s=0.1, jitter_s=0.2))
    for k in range(200):
        channel.send("a", "b", k, time=0.1 * k, size_bytes=1)
    got = list(channel.receive(time=1e9))
    assert all(m.received_s >= m.sent_s for m in got)
    assert [m.payload for m in got] != sorted(m.payload for m in got)
    assert [m.received_s for m in got] == sorted(m.received_s for m in got)


def test_clear_drops_what_is_in_flight():
    channel = Channel(np.random.default_rng(4), ChannelOptions(latency_s=1.0))
    channel.send("a", "b", None, time=0.0, size_bytes=1)
    channel.clear()
    assert list(channel.receive(time=10.0)) == []
    assert channel.traffic.sent == 1


def test_message_size_of_a_graph():
    plain = ObjectGraph.from_positions(np.ones((5, 3)))
    assert message_size(plain) == HEADER_BYTES + 4 * (15 + 5 + 5 + 5)
    full = ObjectGraph.from_positions(
        np.ones((5, 3)), covariances=np.tile(np.eye(3), (5, 1, 1)), embedding=np.ones((5, 8))
    )
    assert message_size(full) == HEADER_BYTES + 4 * (15 + 5 + 5 + 30 + 40)
    assert message_size(ObjectGraph.from_positions(np.zeros((0, 3)))) == HEADER_BYTES


@pytest.mark.parametrize(
    ("field", "value"),
    [("loss", 1.5), ("loss", np.nan), ("latency_s", -1.0), ("jitter_s", -0.1), ("bandwidth_bytes_s", 0.0)],
)
def test_bad_options_are_named_with_their_value(field, value):
    with pytest.raises(ValueError, match=f"^{field} must .*, got {value}$"):
        ChannelOptions(**{field: value})


@pytest.mark.parametrize(("field", "value"), [("time", np.nan), ("size_bytes", -1)])
def test_bad_messages_are_named_with_their_value(field, value):
    channel = Channel(np.random.default_rng(0))
    with pytest.raises(ValueError, match=f"^{field} must .*, got {value}$"):
        channel.send("a", "b", None, **{"time": 0.0, "size_bytes": 1, field: value})
