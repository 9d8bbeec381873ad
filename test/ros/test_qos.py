from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import String

from meslam_ros.client import MeslamClient
from meslam_ros.qos import MatchedSubscription, describe, images

TOPIC = "some/images"
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT


@pytest.fixture
def driver() -> Iterator[Node]:
    node = rclpy.create_node("driver")
    yield node
    node.destroy_node()


def offered(node: Node) -> list[ReliabilityPolicy]:
    """Reliabilities that the subscriptions of the topic ask for."""
    infos = node.get_subscriptions_info_by_topic(f"/{TOPIC}")
    return [info.qos_profile.reliability for info in infos]


@pytest.mark.parametrize("reliability", [RELIABLE, BEST_EFFORT])
def test_subscription_follows_the_publishers_reliability(
    reliability: ReliabilityPolicy, driver: Node, client: MeslamClient
) -> None:
    received: list[String] = []
    subscription = MatchedSubscription(client.node, String, TOPIC, received.append)
    subscription.update()
    assert offered(driver) == []
    publisher = driver.create_publisher(String, TOPIC, images(reliability))

    def subscribed() -> bool:
        subscription.update()
        return publisher.get_subscription_count() == 1

    assert client.spin_until(subscribed, 5.0)
    assert offered(driver) == [reliability]
    publisher.publish(String(data="image"))
    assert client.spin_until(lambda: bool(received), 5.0)
    assert subscription.received == 1


def test_second_publisher_with_less_to_offer_is_heard_too(
    driver: Node, client: MeslamClient
) -> None:
    received: list[String] = []
    subscription = MatchedSubscription(client.node, String, TOPIC, received.append)
    publishers = [
        driver.create_publisher(String, TOPIC, images(kind)) for kind in (RELIABLE, BEST_EFFORT)
    ]

    def all_matched() -> bool:
        subscription.update()
        return all(publisher.get_subscription_count() == 1 for publisher in publishers)

    assert client.spin_until(all_matched, 5.0)
    for publisher in publishers:
        publisher.publish(String(data="image"))
    assert client.spin_until(lambda: len(received) == 2, 5.0)


def test_messages_that_do_not_arrive_are_counted(driver: Node, client: MeslamClient) -> None:
    received: list[String] = []
    subscription = MatchedSubscription(client.node, String, TOPIC, received.append)

    def ready(publisher: Publisher) -> bool:
        subscription.update()
        return publisher.get_subscription_count() == 1 and len(subscription.publishers) == 1

    publisher = driver.create_publisher(String, TOPIC, images(RELIABLE))
    assert client.spin_until(lambda: ready(publisher), 5.0)
    subscription.update()
    publisher.publish(String(data="first"))
    assert client.spin_until(lambda: len(received) == 1, 5.0)
    # Nobody takes them meanwhile, and the subscription keeps the last ten.
    for number in range(30):
        publisher.publish(String(data=str(number)))
    assert client.spin_until(lambda: bool(received) and received[-1].data == "29", 5.0)
    assert subscription.lost == 31 - subscription.received > 0
    # Another publisher counts for itself.
    lost = subscription.lost
    driver.destroy_publisher(publisher)
    again = driver.create_publisher(String, TOPIC, images(RELIABLE))
    assert client.spin_until(lambda: ready(again), 5.0)
    again.publish(String(data="again"))
    assert client.spin_until(lambda: received[-1].data == "again", 5.0)
    assert subscription.lost == lost


def test_publishers_are_described_for_people(driver: Node, client: MeslamClient) -> None:
    subscription = MatchedSubscription(client.node, String, TOPIC, lambda message: None)
    assert describe(subscription.publishers) == "no publisher"
    publisher = driver.create_publisher(String, TOPIC, images(BEST_EFFORT))
    expected = "1 publisher: driver (best effort)"
    assert client.spin_until(lambda: describe(subscription.publishers) == expected, 5.0)
    assert publisher.topic_name == subscription.topic
