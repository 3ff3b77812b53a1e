"""Copies at the driver's node: they outlive the node that made what they are of."""

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster
from ray.exceptions import ObjectLostError

from service.cluster.copies import Copies


@pytest.fixture
def nodes():
    """A cluster of the driver's node and another one, which has all cores."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    other = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    yield cluster, other
    ray.shutdown()
    cluster.shutdown()


@ray.remote(max_retries=0)
def made(value):
    """Too large to come back with the answer: it stays where it was made."""
    return np.full(100_000, value)


def test_what_is_kept_outlives_its_node(nodes):
    cluster, other = nodes
    old, new, forgotten = (made.remote(value) for value in (1.0, 2.0, 3.0))
    copies = Copies()
    first = copies.keep([old, new])
    assert set(first) == {old, new}
    ray.wait([old, new, forgotten], num_returns=3, fetch_local=False)
    first[old](old)
    assert set(copies.keep([old, new])) == {new}  # the other is here
    again = copies.keep([new])
    again[new](new)
    first[old](old)  # an answer that comes late, of what nobody needs any more
    assert copies.keep([new]) == {}
    cluster.remove_node(other)
    assert ray.get(new, timeout=60.0)[0] == 2.0
    with pytest.raises(ObjectLostError):
        ray.get(forgotten, timeout=60.0)
    copies.keep([forgotten])[forgotten](forgotten)  # its loss is for whoever needs it
    assert set(copies.keep([forgotten])) == {forgotten}
