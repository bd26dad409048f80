"""Layers, as Flax modules; the only importer of `flax.linen`.

layers         Linear, RMSNorm, MLP
recurrent      DreamerV3's block GRU, posterior and prior
convolution    DreamerV3's encoder and decoder of images
relu           STORM's linear layers
strided        STORM's encoder and decoder of images
batch_norm     STORM's BatchNorm
transformer    STORM's sequence model
"""

from vawm.nets.convolution import HALVINGS, STAGE_WIDTHS, ImageDecoder, ImageEncoder
from vawm.nets.layers import MLP, UNIT_VARIANCE, Layer, Linear, rms_norm
from vawm.nets.recurrent import RSSM, BlockGRU
from vawm.nets.relu import LayerNorm, ReluMLP, UniformLinear
from vawm.nets.strided import STAGE_WIDTHS as STRIDED_WIDTHS
from vawm.nets.strided import StridedDecoder, StridedEncoder
from vawm.nets.transformer import Cache, Storm, Transformer, causal, fill

__all__ = [
    "HALVINGS",
    "MLP",
    "RSSM",
    "STAGE_WIDTHS",
    "STRIDED_WIDTHS",
    "UNIT_VARIANCE",
    "BlockGRU",
    "Cache",
    "ImageDecoder",
    "ImageEncoder",
    "Layer",
    "LayerNorm",
    "Linear",
    "ReluMLP",
    "Storm",
    "StridedDecoder",
    "StridedEncoder",
    "Transformer",
    "UniformLinear",
    "causal",
    "fill",
    "rms_norm",
]
