import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.field_components.mlp import MLPWithHashEncoding

from avp_nerfstudio.method.hash_encoding import CompiledHashEncoding, compile_hash_encodings


@pytest.fixture(params=[(5, 2, 8), (3, 4, 12)], ids=["crowded table", "roomy table"])
def encoding(request):
    levels, features, size = request.param
    torch.manual_seed(0)
    return HashEncoding(levels, 4, 40, size, features, hash_init_scale=1.0, implementation="torch")


def gradient(encoding, positions, weights):
    encoding.hash_table.grad = None
    (encoding(positions) * weights).sum().backward()
    return encoding.hash_table.grad


def test_values_and_table_gradients_are_nerfstudios(encoding):
    compiled = CompiledHashEncoding(encoding)
    positions = torch.cat([torch.rand(400, 3), torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.25, 0.5, 0]])])
    expected = encoding(positions)
    torch.testing.assert_close(compiled(positions), expected)
    weights = torch.randn_like(expected)
    torch.testing.assert_close(gradient(compiled, positions, weights), gradient(encoding, positions, weights))


def test_any_leading_shape_is_kept(encoding):
    positions = torch.rand(3, 5, 3)
    torch.testing.assert_close(CompiledHashEncoding(encoding)(positions), encoding(positions))


def test_exchanging_encodings_keeps_parameters_and_their_names():
    network = MLPWithHashEncoding(num_levels=3, log2_hashmap_size=8, out_dim=4, implementation="torch")
    before = dict(network.named_parameters())
    compile_hash_encodings(network)
    after = dict(network.named_parameters())
    assert list(after) == list(before)
    assert all(after[name] is before[name] for name in before)
    assert any(isinstance(module, CompiledHashEncoding) for module in network.modules())
