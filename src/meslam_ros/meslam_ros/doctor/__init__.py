"""What `meslam doctor` looks at where ROS is: the installation, and whether messages arrive."""

from __future__ import annotations

from collections.abc import Iterator

from meslam_core.doctor import Finding


def examine_ros() -> Iterator[Finding]:
    """Distribution, rclpy, interfaces, middleware, DDS and shared memory."""
    from meslam_ros.doctor.exchange import examine_exchange
    from meslam_ros.doctor.fast_dds import examine_fast_dds
    from meslam_ros.doctor.installation import examine_installation

    findings = list(examine_installation())
    yield from findings
    yield from examine_fast_dds()
    # Without rclpy and interfaces nothing can be exchanged, and why is said above.
    if all(finding.status != "fail" for finding in findings):
        yield examine_exchange()
