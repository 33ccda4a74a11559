# docker build -t crosscue . && docker run --rm -v "$PWD:/data" crosscue demo
FROM python:3.11-slim
COPY . /crosscue
RUN pip install --no-cache-dir uv \
 && uv pip install --system --no-cache --torch-backend cpu --constraints /crosscue/requirements.lock /crosscue \
 && rm -rf /crosscue
# Drives, vehicle files and runs: mount a folder here.
WORKDIR /data
VOLUME /data
ENTRYPOINT ["crosscue"]
CMD ["demo"]
