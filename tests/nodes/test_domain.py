"""A domain for a graph of its own: nobody is in it, and nobody else gets it."""

import socket

import pytest

from derail_ros import demo
from derail_ros.nodes import domain
from derail_ros.nodes.domain import DOMAINS, free_domain, in_use


def test_domains_are_given_once_and_given_back() -> None:
    with free_domain(40) as one, free_domain(40) as other:
        assert one != other
        assert 1 <= one <= DOMAINS and 1 <= other <= DOMAINS
    with free_domain(40) as again:
        assert again == one


def test_a_domain_with_a_participant_is_passed_over() -> None:
    with free_domain(70) as one:
        assert not in_use(one)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("127.0.0.1", 7410 + 250 * one))
        assert in_use(one)
        with free_domain(70) as other:
            assert other != one


def test_what_goes_wrong_inside_is_not_hidden() -> None:
    with pytest.raises(BlockingIOError), free_domain(5):
        raise BlockingIOError


def test_all_taken(monkeypatch) -> None:
    monkeypatch.setattr(domain, "in_use", lambda _: True)
    with pytest.raises(RuntimeError, match="no free ROS domain among 1 to 101"), free_domain(1):
        pass


@pytest.mark.ros
def test_the_demonstration_says_so_in_a_line(monkeypatch, capsys) -> None:
    monkeypatch.setattr(domain, "in_use", lambda _: True)
    assert demo.main([]) == 1
    assert capsys.readouterr().err == "error: no free ROS domain among 1 to 101\n"


@pytest.mark.ros
def test_a_real_participant_is_seen() -> None:
    rclpy = pytest.importorskip("rclpy")
    with free_domain(90) as number:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=number)
        try:
            node = rclpy.create_node("somebody", context=context)
            assert in_use(number)
            node.destroy_node()
        finally:
            rclpy.shutdown(context=context)
        assert not in_use(number)
