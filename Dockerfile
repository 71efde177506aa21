# Runs the README's two commands on a CPU:
#   docker build -t eitbench . && docker run --rm eitbench                       (eitbench run)
#   docker run --rm --security-opt seccomp=unconfined eitbench .ci/run           (the tests, bubblewrap included)
FROM python:3.13-slim
RUN apt-get update && apt-get install -y --no-install-recommends bubblewrap && rm -rf /var/lib/apt/lists/*
WORKDIR /eitbench
COPY . .
RUN python3 -m venv .venv && .venv/bin/pip install --no-cache-dir -q -c constraints.txt -e '.[bench]'
ENV PATH=/eitbench/.venv/bin:$PATH
CMD ["eitbench", "run"]
