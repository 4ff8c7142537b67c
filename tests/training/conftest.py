"""One thread for torch: on small matrices several only wait for each other."""

import torch

torch.set_num_threads(1)
