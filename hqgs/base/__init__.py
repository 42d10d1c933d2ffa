"""What every room stands on: files, threads, processes, machine, values, text. It imports nothing of hqgs."""
