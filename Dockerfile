# The service:
# docker build -t pickplace . && export PICKPLACE_TOKEN=$(openssl rand -hex 32) && docker run -p 8000:8000 -e PICKPLACE_TOKEN pickplace
# Other weights or settings: docker run ... pickplace pretrained/mixed --host 0.0.0.0 --tote-size 8 8 8
FROM python:3.12-slim
WORKDIR /app
COPY pyproject.toml README.md LICENSE ./
COPY pickplace pickplace
COPY conf conf
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu '.[serve]' && useradd --create-home planner
USER planner
EXPOSE 8000
HEALTHCHECK CMD python -c "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8000/health')"
ENTRYPOINT ["pickplace-serve"]
CMD ["pretrained/r4", "--host", "0.0.0.0"]
