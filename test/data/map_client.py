"""What tests say to a map server, as tracking and as somebody who uses the map."""

from __future__ import annotations

import array

import numpy as np
from data.analytic_scene import GRID, SphereInRoom, learnt_field, stored

from meslam_core.map.stored_region import StoredRegion
from meslam_interfaces.action import ExportMap
from meslam_interfaces.msg import RegionModel
from meslam_interfaces.srv import ListRegions, QueryOccupancy
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.qos import latched
from meslam_ros.region_messages import region_model

WAIT_S = 30.0
SCENE = SphereInRoom()
Code = ExportMap.Result


def two_regions() -> list[StoredRegion]:
    """Two neighbours that both know the sphere in the room."""
    field = learnt_field()
    center = GRID.center((1, 0, 0))
    neighbour = stored(field, SCENE, (1, 0, 0), (center[0], center[1], center[2]))
    return [stored(field, SCENE), neighbour]


def publish(client: MeslamClient, *models: RegionModel) -> None:
    """Publish models as tracking does; the publishers live as long as the client."""
    for model in models:
        publisher = client.node.create_publisher(RegionModel, topics.REGION_MODELS, latched())
        publisher.publish(model)


def model(region: StoredRegion, map_id: str = "first") -> RegionModel:
    return region_model(region, map_id, "map", "int8")


def listed(client: MeslamClient) -> ListRegions.Response:
    return client.call(ListRegions, topics.LIST_REGIONS)


def fill(client: MeslamClient, *regions: StoredRegion) -> None:
    """Give the server regions and wait until it has them."""
    publish(client, *(model(region) for region in regions))
    assert client.spin_until(lambda: len(listed(client).regions.regions) == len(regions), WAIT_S)


def query(client: MeslamClient, points: np.ndarray, **fields) -> QueryOccupancy.Response:
    request = QueryOccupancy.Request(
        points=array.array("f", np.asarray(points, np.float32).reshape(-1).tolist()), **fields
    )
    return client.call(QueryOccupancy, topics.QUERY_OCCUPANCY, request)
