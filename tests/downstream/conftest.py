import pytest

import service


@pytest.fixture(scope="session")
def champion():
    return service.load_primitives("panda-cube@champion", registry="no registry here")
