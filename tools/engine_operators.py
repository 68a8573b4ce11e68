"""Say which operators an exported garment uses, and which of the engines' lists have them.

    python -m tools.engine_operators tshirt.onnx

A list is what the maker documents, not what was tried in the engine. It ends with 1 where a list lacks an operator.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

__all__ = ["ENGINES", "main", "operators", "unlisted"]

# Operators of the default domain, for float32.
ENGINES: dict[str, str] = {
    # Inference Engine 2.2, all three backends:
    # docs.unity3d.com/Packages/com.unity.ai.inference@2.2/manual/supported-operators.html
    "Unity": """
        Abs Acos Acosh Add ArgMax ArgMin Asin Asinh Atan Atanh AveragePool BatchNormalization Bernoulli Cast CastLike
        Ceil Celu Clip Concat Constant ConstantOfShape Conv ConvTranspose Cos Cosh CumSum DepthToSpace Div Dropout Elu
        Equal Erf Exp Expand Flatten Floor Gather GatherElements GatherND Gemm GlobalAveragePool GlobalMaxPool Greater
        GreaterOrEqual GridSample HardSigmoid HardSwish Hardmax Identity InstanceNormalization LayerNormalization
        LeakyRelu Less LessOrEqual Log LogSoftmax MatMul Max MaxPool Mean Min Mish Mod Mul Neg OneHot PRelu Pad Pow
        RandomNormal RandomNormalLike RandomUniform RandomUniformLike Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum
        ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Resize RoiAlign
        Round Scatter ScatterElements ScatterND Selu Shape Shrink Sigmoid Sign Sin Sinh Size Slice Softmax Softplus
        Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Tile Transpose Trilu Unsqueeze
        Upsample Where
    """,
    # NNERuntimeORTDml is ONNX Runtime with DirectML, the last part of
    # github.com/microsoft/onnxruntime/blob/main/docs/OperatorKernels.md, kernels for opset 15:
    "Unreal, DirectML": """
        Abs Acos Acosh Add ArgMax ArgMin Asin Asinh Atan Atanh AveragePool BatchNormalization Cast CastLike Ceil Celu
        Clip Concat ConstantOfShape Conv ConvTranspose Cos Cosh CumSum DepthToSpace Div Dropout Einsum Elu Equal Erf Exp
        Expand EyeLike Flatten Floor GRU Gather GatherElements GatherND Gemm GlobalAveragePool GlobalLpPool
        GlobalMaxPool Greater GreaterOrEqual HardSigmoid Hardmax Identity If InstanceNormalization IsInf IsNaN LRN LSTM
        LeakyRelu Less LessOrEqual Log LogSoftmax LpNormalization LpPool MatMul Max MaxPool MaxRoiPool MaxUnpool Mean
        MeanVarianceNormalization Min Mod Mul Neg NonZero OneHot PRelu Pad Pow RNN Range Reciprocal ReduceL1 ReduceL2
        ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape
        Resize ReverseSequence RoiAlign Round Scatter ScatterElements ScatterND Selu Shape Shrink Sigmoid Sign Sin Sinh
        Size Slice Softmax Softplus Softsign SpaceToDepth Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Tile TopK
        Transpose Trilu Unsqueeze Upsample Where
    """,
}
LISTS = {engine: frozenset(names.split()) for engine, names in ENGINES.items()}


def operators(file: str | Path) -> Counter[str]:
    """Return how often each operator stands in a graph."""
    import onnx

    return Counter(node.op_type for node in onnx.load(str(file), load_external_data=False).graph.node)


def unlisted(file: str | Path) -> dict[str, list[str]]:
    """Return for each engine the operators of a graph that its list lacks."""
    found = operators(file)
    return {engine: sorted(set(found) - names) for engine, names in LISTS.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return 1 where a list lacks an operator."""
    parser = argparse.ArgumentParser(prog="python -m tools.engine_operators", description=__doc__.splitlines()[0])
    parser.add_argument("file", metavar="FILE.onnx", help="what ncs export wrote")
    file = parser.parse_args(arguments).file
    found = operators(file)
    print(f"{'operator':12}{'times':>6}  " + "  ".join(LISTS))
    for name in sorted(found):
        says = "  ".join(f"{'listed' if name in names else 'NOT LISTED':{len(engine)}}" for engine, names in LISTS.items())
        print(f"{name:12}{found[name]:6}  {says}".rstrip())
    return int(any(unlisted(file).values()))


if __name__ == "__main__":
    raise SystemExit(main())
