"""What all layers stand on: files, threads, processes, machine, values, text. It imports nothing of hqgs."""
