"""Images of half the size."""

import torch

from framework.splats.resolution import doubled, halved, halved_distances


def test_a_half_image_is_the_mean_of_four_and_doubles_back() -> None:
    image = torch.arange(5 * 6 * 3, dtype=torch.float32).view(5, 6, 3)
    half = halved(image)
    assert half.shape == (2, 3, 3)
    torch.testing.assert_close(half[1, 2], image[2:4, 4:6].reshape(4, 3).mean(0))
    whole = doubled(half, image)
    assert torch.equal(whole[4], image[4])  # an odd last row stays
    torch.testing.assert_close(halved(whole), half)


def test_distances_are_not_mixed_and_no_known_one_is_lost() -> None:
    distances = torch.tensor([[0.0, 3.0, 5.0, 2.0, 9.0], [0.0, 0.0, 0.0, 4.0, 9.0], [0.0, 0.0, 0.0, 0.0, 7.0]])
    assert halved_distances(distances).tolist() == [[3.0, 2.0]]
    assert halved_distances(torch.zeros(4, 4)).tolist() == [[0.0, 0.0], [0.0, 0.0]]
