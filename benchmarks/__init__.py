"""What hqgs needs and how right it is: `python -m benchmarks NAME` measures it. Not part of the package."""
