"""Layout of one network in NetworkBank.words: a head of float64, then its packed numbers (integers exact to 2^53)."""

from hilrunner.plant.foreign_call import FOREIGN_SIZE
from hilrunner.plant.generic_kernel import MAX_LAYERS

KERNEL_NONE = 0
KERNEL_VECTOR = 1  # [25, 10, 20] tanh, linear output
KERNEL_GENERIC = 2
KERNEL_FOREIGN = 3
KERNEL_GRAPH = 4
KERNEL_NAMES = ("none", "vector", "generic", "onnxruntime", "graph")

# in which quantities a flow network of circuit paper is asked
FORM_SHARE = 0  # p1, root of p2, share of the spool: what `hilrunner train` makes
FORM_PINNED = 3  # p1, p2, command: spool on its open stop
FORM_PLAIN = 4  # p1, p2, command, opening

MAX_QUANTITIES = 8  # inputs or outputs of one network

HEAD_KERNEL = 0
HEAD_INPUTS = 1
HEAD_OUTPUTS = 2
HEAD_LAYERS = 3
HEAD_ADDRESS = 4  # of the compiled kernel
HEAD_FORM = 5  # FORM_*
HEAD_LOW = 8  # MAX_QUANTITIES words: training range, low
HEAD_HIGH = HEAD_LOW + MAX_QUANTITIES
HEAD_FOREIGN = HEAD_HIGH + MAX_QUANTITIES  # FOREIGN_SIZE words: addresses
HEAD_ROWS = HEAD_FOREIGN + FOREIGN_SIZE  # MAX_LAYERS + 1 words: inputs, then rows of each layer
HEAD_ACTIVATION = HEAD_ROWS + MAX_LAYERS + 1  # MAX_LAYERS words
HEAD_SIZE = 56  # whole lines of 64 bytes
assert HEAD_ACTIVATION + MAX_LAYERS <= HEAD_SIZE
