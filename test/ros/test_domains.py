"""Domains that nobody uses."""

from __future__ import annotations

from meslam_ros.domains import LAST_DOMAIN, free_domain, taken_domains


def test_domains_are_taken_whose_ports_lie_in_shared_memory(tmp_path) -> None:
    for port in (7400 + 250 * 7 + 13, 7400 + 250 * 8, 7400 + 250 * 42 + 249):
        (tmp_path / f"fastrtps_port{port}").touch()
    (tmp_path / "fastrtps_port7651_el").touch()
    (tmp_path / "sem.fastrtps_port9999_mutex").touch()
    assert taken_domains(tmp_path) == {7, 8, 42}


def test_a_free_domain_is_the_next_that_is_not_taken() -> None:
    assert free_domain(5, {5, 7}) == 6
    assert free_domain(5, {6, 7}) == 8
    assert free_domain(LAST_DOMAIN - 1, {LAST_DOMAIN}) == 1
    assert free_domain(3, set(range(200))) == 4
