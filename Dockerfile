# make dist && docker build -t mauvecl . && docker run --rm -v "$PWD:/work" mauvecl detect
# Untested as an image (no container runtime where it was written); its steps were run in a minimal Debian, by hand.
FROM python:3.13-slim
# PoCL links kernels with ld. Its wheel exists for x86-64 only; elsewhere Debian's is used.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends binutils \
    && if [ "$(dpkg --print-architecture)" != amd64 ]; then apt-get install --yes --no-install-recommends pocl-opencl-icd; fi \
    && rm -rf /var/lib/apt/lists/*
COPY dist/*.whl /tmp/
RUN pip install --no-cache-dir "$(ls /tmp/mauvecl-*.whl)[all]" && rm /tmp/*.whl
RUN useradd --uid 1000 --create-home mauve && mkdir /work && chown mauve /work
USER 1000
WORKDIR /work
# Last, and an error if the driver computes anything else than it should.
RUN mauvecl selftest
ENTRYPOINT ["mauvecl"]
