"""Building blocks of the algorithms' networks. Array-only pytrees; written for one environment, vmapped."""
