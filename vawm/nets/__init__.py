"""Layers, as Flax modules; the only importer of `flax.linen`.

layers         Linear, RMSNorm, MLP
recurrent      block GRU, posterior and prior of DreamerV3
convolution    its encoder and decoder of images
"""

from vawm.nets.convolution import HALVINGS, STAGE_WIDTHS, ImageDecoder, ImageEncoder
from vawm.nets.layers import MLP, UNIT_VARIANCE, Layer, Linear, rms_norm
from vawm.nets.recurrent import RSSM, BlockGRU

__all__ = [
    "HALVINGS",
    "MLP",
    "RSSM",
    "STAGE_WIDTHS",
    "UNIT_VARIANCE",
    "BlockGRU",
    "ImageDecoder",
    "ImageEncoder",
    "Layer",
    "Linear",
    "rms_norm",
]
