"""What tests on a GPU share: where it is, and that there has to be one."""

import pytest
import torch

GPU = torch.device("cuda:0")
NEEDS_GPU = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    pytest.mark.filterwarnings("ignore:Attempting to run cuBLAS"),  # torch's, of its threads
]
