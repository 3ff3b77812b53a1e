"""Copies at the driver's node: they outlive the node that made what they are of."""

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster
from ray.exceptions import ObjectLostError

from service.cluster.remote_worker import take_copies


@ray.remote(max_retries=0)
def made(value):
    """Too large to come back with the answer: it stays where it was made."""
    return np.full(100_000, value)


def test_what_is_copied_outlives_its_node():
    bare = {"include_dashboard": False, "no_monitor": True, "include_log_monitor": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0} | bare)  # the other node has all cores
    try:
        other = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        copied, late, forgotten = (made.remote(value) for value in (1.0, 2.0, 3.0))
        ray.wait([copied, late, forgotten], num_returns=3, fetch_local=False)
        copies = {copied: None, late: None}
        take_copies(copies, {copied, forgotten})
        assert copies.keys() == {copied, late}
        assert copies[copied][0] == 1.0
        assert copies[late] is None
        cluster.remove_node(other)
        assert ray.get(copied, timeout=60.0)[0] == 1.0
        with pytest.raises(ObjectLostError):
            ray.get(forgotten, timeout=60.0)
        take_copies(copies, {late})  # its loss is for who needs it
        assert copies.keys() == {copied}
    finally:
        ray.shutdown()
        cluster.shutdown()
